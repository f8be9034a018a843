import pytest

from sb3_flock.cli import main
from sb3_flock.evaluation.model_cards import read_card
from sb3_flock.pretrained import shipped_policies


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def test_the_list_has_a_line_for_each_policy_in_80_columns(capsys):
    assert main(["policies"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    rows = {words[0]: words for words in map(str.split, lines) if words and words[0] in shipped_policies()}
    assert list(rows) == list(shipped_policies())
    assert "…" not in "".join(lines)
    assert rows["ddpg-5v2o"][:8] == ["ddpg-5v2o", "5v2o", "walk", "RL", "0.127", "0.02%", "0.27%", "95.53%"]
    assert any("crossing" in line.split() for line in lines)  # the task, perhaps in a second line
    for name, words in rows.items():
        card = read_card(name)
        shipped = next(seed["metrics"] for seed in card["seeds"] if seed["seed"] == card["shipped_seed"])
        *_, method, tracking, _, _, connected, free, success = words
        assert method == ("RL+MPC" if card["config"]["train_env"]["expert"] else "RL")
        assert tracking == f"{shipped['tracking_error']:.3f}"
        assert connected == f"{shipped['connectivity']:.2%}"
        recorded = shipped.get("violation_free_rate")  # cards of earlier versions do not have it
        assert free == ("-" if recorded is None else f"{recorded:.2%}")
        assert success == f"{shipped['success_rate']:.2%}"


def test_a_name_shows_its_card(capsys):
    assert main(["policies", "ddpg-bc-5v2o"]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    words = " ".join(shown.split())
    for expected in (
        "task 5 vehicles, 2 obstacles (walk)",
        "method ddpg: reinforcement learning with an MPC expert, which drives 25% of the episodes; behavior cloning of its "
        "actions (weight 10); motion channels",
        "trained 500110 transitions, 23.5 minutes",
        "trainings 3, which differ in the seed; the policy is that of seed 1",
        "neighbor_violation_rate 0.34% 0.34%",
        "connectivity 99.29% 99.23%",
        "Results on 1000 episodes",
        "file ddpg-bc-5v2o.zip, 0.9 MB",
    ):
        assert expected in words
    assert main(["policies", "ddpg-3v1o"]) == 0
    assert "method ddpg: reinforcement learning alone trained" in " ".join(capsys.readouterr().out.split())


def test_an_unknown_name_is_one_line_with_all_names_and_an_old_one_works(fails, capsys):
    fails(["policies", "ddpg-5v3o"], "ddpg-5v3o: not a shipped policy; did you mean ddpg-5v", *shipped_policies())
    assert main(["policies", "paper-3v1o"]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("ddpg-3v1o\n")
    assert captured.err.startswith("sb3-flock: warning: policy paper-3v1o is now ddpg-3v1o; ")
