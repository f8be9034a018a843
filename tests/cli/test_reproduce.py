from pathlib import Path

import pytest

from sb3_flock.cli import main


@pytest.mark.parametrize(("words", "expected"), [([], ("results", False)), (["--quick", "-o", "mine"], ("mine", True))])
def test_the_folder_and_the_length_are_passed_on(words, expected, monkeypatch, capsys):
    calls = []

    def reproduce(out, quick):
        calls.append((str(out), quick))
        return Path(out) / "results.md"

    monkeypatch.setattr("sb3_flock.reproduce.reproduce", reproduce)
    assert main(["reproduce", *words]) == 0
    assert calls == [expected]
    assert capsys.readouterr().out == f"{expected[0]}/results.md\n"
