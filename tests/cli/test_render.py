from sb3_flock.cli import main


def test_render_writes_the_output_and_prints_its_path(tmp_path, capsys):
    words = ["render", "--controller", "random", "--set", "max_cycles=3"]
    for flag in ("-o", "--output"):
        path = tmp_path / f"paths{flag}.svg"
        assert main([*words, flag, str(path)]) == 0
        assert capsys.readouterr().out == f"{path}\n"
        assert path.read_text().startswith("<?xml")
