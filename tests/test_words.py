"""The words of the previous release are found only where old names are read, and in the changelog, which lists them all."""

import ast
import re
from pathlib import Path

import pytest

from sb3_flock import _renamed

ROOT = Path(__file__).parents[1]

OLD_WORDS = {
    r"\bteach(ers?|es)?\b|\btaught\b|TEACHERS": "expert",
    r"\bpupils?\b": "student",
    r"\badvice\b|\badvis(e|es|ed|er|ers)\b|Advised": "expert actions",
    r"\bguidance\b|\badvice_gap\b": "bc_coef, bc_loss (behavior cloning)",
    r"\bforesight\b|ForesightGains": "MPC, MPCConfig",
    r"\bsecond[ _]looks?\b|\blook_back\b": "motion channels, motion_lag",
    r"\bpractic(e|es|ed|ing)\b|PracticeConfig": "training env, train_env",
    r"\bfines?\b|\bfined\b": "penalty",
    r"\btold\b|\btells?\b": "reports, shows",
    r"\bhand-written (law|controller)s?\b": "baseline controller",
    r"\btoo[ _]close\b": "separation violation",
    r"\bsettled\b": "steady state",
    r"\bside_by_side\b|SideBySide": "multi_flock",
    r"\bfly_one\b|\bfly_together\b|\bflown\b|\bflyers?\b": "rollout",
    r"\bfilm(s|ed)?\b": "video",
    r"\bFadingNoise\b|\bFiniteLosses\b|\bDemonstrated\w+": "LinearNoiseDecay, StopOnNonFiniteLoss, ExpertEnv",
    r"\bsurroundings\b|\binexactness\b|\bwrite_whole\b": "runtime_info, reproducibility_warnings, atomic_write",
    r"\bjudg(e|es|ed|ing)\b": "evaluate",
    r"\bddpg-stock\b": "ddpg-sb3",
    r"\bpaper-\dv\do\b|\bsecond-looks?\b": "ddpg, flock",
    r"\bpromises\.md|\bchoices\.md|\brecipe\.md": "guarantees.md, paper_deviations.md, method.md",
    r"\bLearnerConfig\b|\blearner\.": "AlgorithmConfig, algorithm.",
}
"""Old words to new ones, by pattern."""

READERS_OF_OLD_NAMES = (
    "CHANGELOG.md",
    "sb3_flock/_renamed.py",
    "sb3_flock/serialization/migrate.py",
    "sb3_flock/serialization/format2.py",
    "tests/cli/test_migrate.py",
    "tests/data/",
    "tests/serialization/test_migrate.py",
    "tests/serialization/test_rewrite.py",
    "tests/test_renamed.py",
    "tests/test_words.py",
)
"""Where old names are read, tested or listed."""

ABOUT_OLD_NAMES = re.compile(r"(^|_)old_|previous_release", re.IGNORECASE)
"""Tests and constants of other test files with such a name are about old names."""

PLAIN_ENGLISH: dict[str, str] = {}
"""Accepted lines, each by a part of it and its file: an old word in its everyday meaning."""


def searched_files():
    for folder, pattern in (
        ("sb3_flock", "**/*.py"),
        ("tests", "**/*.py"),
        ("configs", "*.yaml"),
        ("docs", "**/*.md"),
        ("examples", "*.py"),
        (".", "*.md"),
        (".", ".ci/run"),
    ):
        for path in sorted((ROOT / folder).glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith(READERS_OF_OLD_NAMES):
                yield name, path


def found_in(name, text):
    """Old words in a text, as lines ``file:line: word (now ...)``."""
    accepted = lines_about_old_names(text) if name.startswith("tests/") else set()
    for number, line in enumerate(text.splitlines(), 1):
        if number in accepted or any(part in line for part, file in PLAIN_ENGLISH.items() if file == name):
            continue
        for pattern, new in OLD_WORDS.items():
            for match in re.finditer(pattern, line, re.IGNORECASE):
                yield f"{name}:{number}: {match[0]} (now {new})"


def lines_about_old_names(source):
    """Line numbers of a test file's functions, with their decorators, and constants that are about old names."""
    lines = set()
    for node in ast.parse(source).body:
        names = [getattr(node, "name", "")] + [getattr(target, "id", "") for target in getattr(node, "targets", ())]
        if any(ABOUT_OLD_NAMES.search(name) for name in names):
            first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            lines.update(range(first, node.end_lineno + 1))
    return lines


def test_no_old_word_is_left():
    files = list(searched_files())
    assert len(files) > 100
    found = [line for name, path in files for line in found_in(name, path.read_text(encoding="utf-8"))]
    assert found == [], "\n".join(found)


@pytest.mark.parametrize(
    "word", ["the teacher's", "practice.vehicles", "look_back: 0.2", "too close", "Fly_one(", "a fine of 2"]
)
def test_an_old_word_is_found(word):
    assert len(list(found_in("page.md", f"first line\n{word}\n"))) == 1


def test_only_tests_about_old_names_may_have_them():
    source = "@mark('foresight')\ndef test_{}():\n    assert 'foresight'\n"
    assert len(list(found_in("tests/test_a.py", source.format("old_names_work")))) == 0
    assert len(list(found_in("tests/test_a.py", source.format("a_threshold_is_kept")))) == 2
    assert len(list(found_in("sb3_flock/a.py", source.format("old_names_work")))) == 2


@pytest.mark.parametrize("part", PLAIN_ENGLISH)
def test_every_exception_is_still_used(part):
    lines = (ROOT / PLAIN_ENGLISH[part]).read_text(encoding="utf-8").splitlines()
    assert any(part in line and re.search("|".join(OLD_WORDS), line, re.IGNORECASE) for line in lines)


def test_the_changelog_lists_every_renamed_name():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    rows = {tuple(re.findall(r"`([^`]+)`", line)) for line in changelog.splitlines() if line.startswith("| `")}
    expected = {(owner, old, new) for owner, names in _renamed.FIELDS.items() for old, new in names.items()}
    expected |= {
        (f"{owner}.{name}", old, new) for (owner, name), values in _renamed.VALUES.items() for old, new in values.items()
    }
    expected |= set(_renamed.POLICIES.items()) | set(_renamed._MODULES.items())
    for old, where in _renamed._MEMBERS.items():
        module, _, new = where.partition(":")
        if new != old and module != "serialization.format2":
            expected.add((old, f"sb3_flock.{module}.{new}"))
    assert expected - rows == set()
