import shutil
from pathlib import Path

import pytest

from sb3_flock.cli import main
from sb3_flock.serialization.migrate import FORMAT

DATA = Path(__file__).parent.parent / "data" / "format_2"


def test_a_line_for_each_file_and_nothing_to_do_the_second_time(tmp_path, capsys):
    files = [tmp_path / "paper-3v1o.zip", tmp_path / "config.yaml"]
    shutil.copy(DATA / "policies" / "paper-3v1o.zip", files[0])
    shutil.copy(DATA / "runs" / "ddpg" / "config.yaml", files[1])
    assert main(["migrate", *map(str, files)]) == 0
    captured = capsys.readouterr()
    assert captured.out == "".join(f"{file}: rewritten in the present format ({FORMAT})\n" for file in files)
    assert captured.err == ""
    assert main(["migrate", *map(str, files)]) == 0
    assert capsys.readouterr().out == "".join(f"{file}: has the present format ({FORMAT})\n" for file in files)
    assert main(["config", "--config", str(files[1])]) == 0
    assert capsys.readouterr().err == ""


def test_a_refused_file_is_one_line_and_does_not_stop_the_others(tmp_path, capsys):
    checkpoint = next(path for path in (DATA / "runs" / "ddpg").glob("rl_model_*_steps.zip"))
    policy = tmp_path / "policy.zip"
    shutil.copy(DATA / "policies" / "paper-3v1o.zip", policy)
    before = checkpoint.read_bytes()
    assert main(["migrate", "no/such.zip", str(checkpoint), __file__, str(policy)]) == 2
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [
        "sb3-flock: no/such.zip: No such file or directory",
        f"sb3-flock: {checkpoint}: a checkpoint, which is migrated when its training is resumed",
        f"sb3-flock: {__file__}: not a policy (zip), model card (.json) or config (.yaml)",
    ]
    assert captured.out == f"{policy}: rewritten in the present format ({FORMAT})\n"
    assert checkpoint.read_bytes() == before


def test_without_a_file_it_is_one_line(fails):
    fails(["migrate"], "FILE")


@pytest.mark.parametrize("name", ["x.zip", "x.json", "x.yaml"])
def test_a_damaged_file_is_one_line(name, tmp_path, fails):
    file = tmp_path / name
    file.write_bytes(b"PK\x05\x06" + bytes(18) if name == "x.zip" else b"{'")
    fails(["migrate", str(file)], str(file))
