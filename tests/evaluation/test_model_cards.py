import json

import numpy as np
import pytest
import torch as th

from sb3_flock import FlockDDPG, evaluate, load_policy, train
from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation import model_cards
from sb3_flock.evaluation.model_cards import median_of_seeds, read_card, ship
from sb3_flock.pretrained import shipped_policies
from sb3_flock.serialization.load import PolicyError, find_policy
from sb3_flock.serialization.migrate import FORMAT, migrate_config
from tests.helpers import quiet, tiny

SHIPPED = sorted(shipped_policies())


def test_policies_for_the_papers_setups_and_more_are_shipped():
    setups = ("3v1o", "5v1o", "5v2o")
    assert {
        "general",
        "crossing-5v2o",
        *(f"{kind}-{setup}" for kind in ("ddpg", "ddpg-bc") for setup in setups),
    } <= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_policy_behaves_as_its_card_says(name):
    policy, card = load_policy(name), read_card(name)
    assert policy.path.stat().st_size < 1_000_000
    check = card["check"]
    metrics = evaluate(policy, episodes=check["episodes"], seed=check["seed"])
    assert metrics["tracking_error"].mean == pytest.approx(check["tracking_error"], abs=0.003)
    config, _ = migrate_config(TrainingConfig, card["config"], FORMAT)
    assert TrainingConfig(**config) == policy.config
    assert card["versions"] == policy.versions
    assert card["shipped_seed"] in [seed["seed"] for seed in card["seeds"]]


def test_a_card_keeps_every_training_and_the_zip_is_the_best_ones(tmp_path, monkeypatch):
    runs = [train(tiny(tmp_path, seed=seed, eval_freq=60), quiet()).folder for seed in (0, 1, 2)]
    path = ship("mine", runs, tmp_path, episodes=3)
    monkeypatch.setattr(model_cards, "shipped_policies", lambda: {"mine": path})
    card = read_card("mine")
    scores = [np.load(run / "evaluations.npz")["score"].min() for run in runs]
    best = int(np.argmin(scores))
    assert [seed["seed"] for seed in card["seeds"]] == [0, 1, 2]
    assert card["shipped_seed"] == best
    shipped, original = load_policy(path), load_policy(runs[best])
    assert path.stat().st_size < 0.4 * original.path.stat().st_size
    assert shipped.config == original.config.replace(output_dir="runs")
    weights = original.policy.state_dict()
    for key, tensor in shipped.policy.state_dict().items():
        assert tensor.dtype == th.float32
        assert th.equal(tensor, weights[key.replace("_target.", ".")].half().float())
    model = FlockDDPG.load(path, device="cpu")  # SB3 reads it as before
    assert th.equal(model.policy.state_dict()["actor.mu.0.weight"], shipped.policy.state_dict()["actor.mu.0.weight"])
    errors = [evaluate(load_policy(run), episodes=3, seed=0)["tracking_error"].mean for run in runs]
    assert median_of_seeds(card)["tracking_error"] == pytest.approx(np.median(errors), abs=1e-4)
    assert len(card["seeds"][0]["curve"]["timesteps"]) == len(card["seeds"][0]["curve"]["return"]) == 5
    json.dumps(card, allow_nan=False)


def test_a_card_without_a_metric_that_came_later_has_no_median_of_it():
    old = {"tracking_error": 0.1, "connectivity": None}
    card = {"seeds": [{"metrics": {**old, "violation_free_rate": 0.5}}, {"metrics": old}]}
    assert median_of_seeds(card) == {"tracking_error": 0.1}


def test_a_file_of_the_same_name_wins_over_a_shipped_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_policy("ddpg-5v2o").parent.name == "pretrained"
    (tmp_path / "ddpg-5v2o").write_bytes(b"mine")
    assert find_policy("ddpg-5v2o").read_bytes() == b"mine"
    with pytest.raises(PolicyError, match="nor one of .*ddpg-5v2o"):
        find_policy("ddpg-9v9o")
