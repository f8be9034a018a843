from sb3_flock.cli import main


def test_compare_prints_the_runs_and_plots_them(run_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    path = tmp_path / "curves.svg"
    assert main(["compare", str(run_folder), str(run_folder), "-o", str(path)]) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines()[-1] == str(path)
    assert captured.out.count("ddpg_2v1o_1") == 2
    assert captured.err == ""
    assert path.read_text().startswith("<?xml")
