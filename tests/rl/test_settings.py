import subprocess
import sys

import pytest
from pydantic import ValidationError

from sb3_flock._renamed import RenamedWarning
from sb3_flock.rl.settings import AlgorithmConfig, NetworkConfig
from sb3_flock.settings import SettingsError


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        (NetworkConfig, {"channels": ()}),
        (NetworkConfig, {"channels": (0,)}),
        (NetworkConfig, {"kernel_size": 16}),
        (NetworkConfig, {"net_arch": (-1,)}),
        (NetworkConfig, {"final_init": 0.0}),
        (NetworkConfig, {"action_bound": "relu"}),
        (NetworkConfig, {"n_critics": 0}),
        (AlgorithmConfig, {"learning_rate": 0.0}),
        (AlgorithmConfig, {"final_learning_rate": -1e-4}),
        (AlgorithmConfig, {"gamma": 1.0}),
        (AlgorithmConfig, {"tau": 0.0}),
        (AlgorithmConfig, {"bc_coef": -1.0}),
        (AlgorithmConfig, {"bc_coef": float("inf")}),
        (AlgorithmConfig, {"n_steps": 0}),
        (AlgorithmConfig, {"utd_ratio": 0.0}),
        (AlgorithmConfig, {"mirror_augmentation": "sometimes"}),
    ],
)
def test_a_value_out_of_range_is_one_line_that_names_it(settings, wrong):
    (name,) = wrong
    with pytest.raises(SettingsError, match=name) as error:
        settings(**wrong)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "value"),
    [
        ("guidance", "bc_coef", 3.0),
        ("mirror", "mirror_augmentation", False),
        ("update_ratio", "utd_ratio", 0.7),
        ("noise", "action_noise_std", 0.2),
        ("final_noise", "final_action_noise_std", 0.1),
    ],
)
def test_parameters_of_the_previous_release_warn_and_work(old, new, value):
    with pytest.warns(RenamedWarning, match=f"AlgorithmConfig: {old} is now {new}; the old name works for one release"):
        config = AlgorithmConfig(**{old: value})
    assert getattr(config, new) == value
    with pytest.raises(SettingsError, match=f"{old} is not a parameter of AlgorithmConfig"):
        AlgorithmConfig(**{old: value, new: value})  # both: the old one is unknown


def test_settings_are_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        NetworkConfig().features_dim = 3


def test_settings_and_registry_are_importable_without_torch():
    code = "import sys; import sb3_flock.rl.registry, sb3_flock.rl.settings; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
