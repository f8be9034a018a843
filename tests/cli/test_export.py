import pytest

from sb3_flock.cli import main

pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("flag", [[], ["-o"], ["--output"]])
def test_the_file_is_an_output_or_the_second_word(flag, run_folder, tmp_path, capsys):
    path = tmp_path / "policy.onnx"
    assert main(["export", str(run_folder), *flag, str(path)]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{path}\n"
    assert "sample inputs" in captured.err
    assert path.stat().st_size > 10_000
