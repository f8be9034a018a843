import pytest

from sb3_flock import load_policy
from sb3_flock.cli import main
from sb3_flock.deploy.onnx_export import ExportResult

pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("flag", [[], ["-o"], ["--output"]])
def test_the_file_is_an_output_or_the_second_word(flag, run_folder, tmp_path, capsys):
    path = tmp_path / "policy.onnx"
    assert main(["export", str(run_folder), *flag, str(path)]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{path}\n"
    assert "sample inputs" in captured.err
    assert path.stat().st_size > 10_000


def test_set_changes_the_scenario(tmp_path, monkeypatch):
    exported = []
    done = ExportResult(tmp_path, 1, 0.0, 0.0)
    monkeypatch.setattr("sb3_flock.deploy.onnx_export.export", lambda *_, scenario: exported.append(scenario) or done)
    words = ["export", "ddpg", "-o", str(tmp_path / "policy.onnx")]
    assert main([*words, "--set", "safety_filter=heading", "--set", "safety_margin=0.01"]) == 0
    assert main(words) == 0
    changed, plain = exported
    assert (changed.safety_filter, changed.safety_margin) == ("heading", 0.01)
    assert plain == load_policy("ddpg").scenario


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("safety_filter=yes", "safety_filter = 'yes': input should be 'off'"),
        ("safety_filter=motion", "safety_filter = motion: motion_lag > 0 is needed"),
        ("motion_lag=0.2", "its observations have the shape"),
    ],
)
def test_settings_that_do_not_fit_the_policy_are_one_line(setting, message, fails, tmp_path):
    fails(["export", "ddpg", "-o", str(tmp_path / "policy.onnx"), "--set", setting], message)
