import pytest

from sb3_flock.cli import main
from sb3_flock.cli.parsing import whole_number


@pytest.mark.parametrize(
    ("text", "number"),
    [("1e5", 100_000), ("1.5e3", 1500), ("2.0", 2), ("7", "7"), ("1.5", "1.5"), ("1e400", "1e400"), ("x", "x")],
)
def test_a_whole_number_may_have_an_exponent(text, number):
    assert whole_number(text) == number
    assert type(whole_number(text)) is type(number)


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["train", "--n_vehicles", "5"], "did you mean --n-vehicles?"),
        (["evaluate", "x", "--n_vehicles=5"], "did you mean --n-vehicles?"),
        (["train", "--total_timesteps", "5"], "did you mean --total-timesteps?"),
        (["train", "--n-vehicle", "3"], "did you mean --n-vehicles?"),
        (["train", "--learning-rate", "1e-3"], "did you mean --set algorithm.learning_rate=VALUE?"),
        (["train", "--lr", "1e-3"], "did you mean --set algorithm.learning_rate=VALUE?"),
        (["evaluate", "x", "--link_range", "0.3"], "did you mean --set link_range=VALUE?"),
        (["export", "x", "--ouput", "y"], "did you mean --output?"),
    ],
)
def test_an_unknown_flag_gets_a_hint(words, hint, fails):
    fails(words, f"sb3-flock {words[0]}: unrecognized arguments: --", hint)


def test_an_unknown_flag_without_a_likeness_gets_none(fails, capsys):
    fails(["train", "--xyzzy"], "unrecognized arguments: --xyzzy (try sb3-flock train --help)")


@pytest.mark.parametrize(
    ("words", "old", "new"),
    [
        (["config", "--scenario", "crossing"], "--scenario", "--obstacle-motion"),
        (["config", "--scenario=crossing"], "--scenario", "--obstacle-motion"),
        (["evaluate", "no/such", "--scenario", "walk"], "--scenario", "--obstacle-motion"),
        (["evaluate", "no/such", "--json", "x"], "--json", "--output"),
        (["render", "no/such", "--out", "x.png"], "--out", "--output"),
        (["render", "no/such", "--scenario", "walk", "-o", "x.png"], "--scenario", "--obstacle-motion"),
        (["play", "no/such", "--scenario", "walk"], "--scenario", "--obstacle-motion"),
        (["compare", "no/such", "--out", "x.png"], "--out", "--output"),
        (["reproduce", "--out", "/dev/null/x"], "--out", "--output"),
        (["sweep", "no/such", "--out", "x"], "--out", "--output"),
    ],
)
def test_a_flag_of_the_previous_release_works_with_one_line(words, old, new, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(words)
    captured = capsys.readouterr()
    warning = f"sb3-flock: warning: {old} is now {new}; the old name works for one release\n"
    assert captured.err.startswith(warning)
    rest = captured.err.removeprefix(warning)
    assert "unrecognized" not in rest
    assert rest.count("\n") == (words[0] != "config")
    if words[0] == "config":
        assert "obstacle_motion: crossing" in captured.out


def test_after_a_double_dash_nothing_is_a_flag(fails):
    fails(["migrate", "--", "--out"], "--out: No such file")
