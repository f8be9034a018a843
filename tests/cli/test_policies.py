import copy
import itertools

import pytest

from sb3_flock.cli import main
from sb3_flock.evaluation import model_cards
from sb3_flock.evaluation.metrics import METRICS
from sb3_flock.evaluation.model_cards import read_card
from sb3_flock.evaluation.tasks import TASKS
from sb3_flock.pretrained import shipped_policies


def text_of(rows):
    return " ".join(itertools.chain.from_iterable(rows))


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def shown(capsys, *words):
    """What the command prints, all of it in 80 columns, as rows of words."""
    assert main(["policies", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)
    return [line.split() for line in lines if line.strip()]


def of_seeds(monkeypatch, name, errors):
    """The card of a policy, as if it were of trainings with these tracking errors; the policy is that of the first."""
    card = read_card(name)
    record = next(seed for seed in card["seeds"] if seed["seed"] == card["shipped_seed"])
    card["seeds"] = []
    for number, error in enumerate(errors):
        seed = copy.deepcopy(record)
        seed["seed"] = number
        for metrics in (seed["metrics"], *seed["tasks"].values()):
            metrics["tracking_error"] = error
        card["seeds"].append(seed)
    card["shipped_seed"] = 0
    monkeypatch.setattr(model_cards, "read_card", lambda _: card)
    return card


def test_the_list_has_a_line_for_each_policy_in_80_columns(capsys):
    lines = shown(capsys)
    rows = {words[0]: words for words in lines if words[0] in shipped_policies()}
    assert list(rows) == list(shipped_policies())
    assert rows["ddpg"][1:4] == ["5v2o", "walk", "RL"]
    assert rows["flock"][1:4] == ["5v2o", "walk", "RL+MPC"]
    for name, words in rows.items():
        card = read_card(name)
        shipped = next(seed["metrics"] for seed in card["seeds"] if seed["seed"] == card["shipped_seed"])
        *_, method, tracking, obstacles, neighbors, connected, free, success = words
        assert method == ("RL+MPC" if card["config"]["train_env"]["expert"] else "RL")
        assert tracking == f"{shipped['tracking_error']:.3f}"
        assert (obstacles, neighbors) == tuple(
            f"{shipped[f'{body}_violation_rate']:.2%}" for body in ("obstacle", "neighbor")
        )
        assert connected == f"{shipped['connectivity']:.2%}"
        assert free == f"{shipped['violation_free_rate']:.2%}"
        assert success == f"{shipped['success_rate']:.2%}"


def test_a_name_shows_its_card(capsys):
    words = text_of(shown(capsys, "flock"))
    for expected in (
        "flock task 5 vehicles, 2 obstacles (walk), safety filter announce",
        "method ddpg: reinforcement learning with an MPC expert; behavior cloning of its actions (weight 10); motion channels",
        f"Results on {read_card('flock')['episodes']} episodes of the task:",
        f"file flock.zip, {shipped_policies()['flock'].stat().st_size / 1e6:.1f} MB",
    ):
        assert expected in words
    words = text_of(shown(capsys, "ddpg"))
    assert "safety filter announce method ddpg: reinforcement learning alone trained" in words


def test_the_card_of_several_trainings_shows_their_median_and_range_and_every_task(capsys, monkeypatch):
    card = of_seeds(monkeypatch, "flock", [0.2, 0.1, 0.4])
    rows = shown(capsys, "flock")
    assert "trainings 3, which differ in the seed; the policy is that of seed 0" in text_of(rows)
    assert ["metric", "policy", "median", "of", "3", "range"] in rows
    assert ["tracking_error", "0.200", "0.200", "0.100", "to", "0.400"] in rows
    assert {row[0] for row in rows} >= set(METRICS)
    assert f"Medians of the 3 trainings on {card['episodes']} episodes of each task, with the same filter:" in text_of(rows)
    for task in TASKS:
        (row,) = [row for row in rows if row[0] == task]
        assert row[1:3] == ["0.200", f"{card['seeds'][0]['tasks'][task]['obstacle_violation_rate']:.2%}"]


def test_the_card_of_one_training_has_no_median(capsys, monkeypatch):
    card = of_seeds(monkeypatch, "ddpg", [0.2])
    rows = shown(capsys, "ddpg")
    assert ["trainings", "1,", "of", "seed", "0"] in rows
    assert ["metric", "policy"] in rows
    assert ["tracking_error", "0.200"] in rows
    assert f"Results on {card['episodes']} episodes of each task, with the same filter:" in text_of(rows)
    assert "median" not in text_of(rows).lower()


def test_a_metric_that_a_card_lacks_is_a_dash(capsys, monkeypatch):
    card = of_seeds(monkeypatch, "ddpg", [0.2, 0.3])
    card["seeds"][1]["metrics"]["success_rate"] = None
    rate = f"{card['seeds'][0]['metrics']['success_rate']:.2%}"
    assert ["success_rate", rate, "-", "-"] in shown(capsys, "ddpg")
    del card["seeds"][0]["metrics"]["success_rate"]
    assert ["success_rate", "-", "-", "-"] in shown(capsys, "ddpg")


def test_a_card_of_the_previous_release_without_a_format_is_shown_as_unfiltered(capsys, monkeypatch):
    card = of_seeds(monkeypatch, "ddpg", [0.2])
    del card["format"]
    for name in ("safety_filter", "shared_detections"):
        del card["config"]["scenario"][name]
    del card["seeds"][0]["tasks"]
    rows = shown(capsys, "ddpg")
    assert "(walk), no safety filter" in " ".join(rows[1])
    assert "each task" not in text_of(rows)


def test_an_unknown_name_is_one_line_with_all_names_and_an_old_one_works(fails, capsys):
    fails(["policies", "flok"], "flok: not a shipped policy; did you mean flock", *shipped_policies())
    assert main(["policies", "paper-3v1o"]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("ddpg\n")
    assert captured.err.startswith(
        "sb3-flock: warning: policy paper-3v1o is now ddpg, with its own task and the safety filter; "
    )
