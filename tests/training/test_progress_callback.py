def test_progress_is_plain_lines_in_a_pipe_and_a_panel_in_a_terminal(tmp_path):
    pipe = quiet()
    train(tiny(tmp_path), pipe)
    plain = pipe.file.getvalue()
    assert "\x1b" not in plain
    assert plain.count("evaluation at") == 3
    assert "torch threads 1" in plain
    terminal = Console(file=io.StringIO(), width=80, force_terminal=True)
    train(tiny(tmp_path), terminal)
    shown = terminal.file.getvalue()
    for words in ("env steps/s", "updates/s", "tracking error", "neighbor violations", "obstacle violations", "return", "evaluation at 120"):
        assert words in shown
