import csv
import threading

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_flock.settings import RunError
from sb3_flock.training.logger import make_logger, quiet_writer_thread

STEPS = "time/total_timesteps"


def log(folder, done, rows):
    """A run's part from ``done`` transitions on: one logged value at each of some transitions."""
    logger = make_logger(folder, done)
    for steps, values in rows:
        for name, value in {STEPS: steps, **values}.items():
            logger.record(name, value)
        logger.dump(steps)
    logger.close()


def read_csv(folder):
    with open(folder / "progress.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def scalars(folder, tag):
    events = EventAccumulator(str(folder))
    events.Reload()
    return {event.step: event.value for event in events.Scalars(tag)}


def test_a_resumed_run_continues_its_logs_from_the_checkpoint(tmp_path):
    log(tmp_path, 0, [(steps, {"train/loss": steps / 100}) for steps in (100, 200, 300)])
    log(tmp_path, 200, [(260, {"train/loss": 9.0}), (350, {"train/loss": 8.0})])
    assert [(int(row[STEPS]), float(row["train/loss"])) for row in read_csv(tmp_path)] == [
        (100, 1.0), (200, 2.0), (260, 9.0), (350, 8.0),
    ]  # fmt: skip
    assert b"\r" not in (tmp_path / "progress.csv").read_bytes()
    assert scalars(tmp_path, "train/loss") == {100: 1.0, 200: 2.0, 260: 9.0, 350: 8.0}


def test_a_new_column_in_a_resumed_run_is_empty_in_the_earlier_rows(tmp_path):
    log(tmp_path, 0, [(100, {"train/loss": 1.0})])
    log(tmp_path, 100, [(200, {"train/loss": 2.0, "train/more": 3.0})])
    rows = read_csv(tmp_path)
    assert [row["train/more"] for row in rows] == ["", "3.0"]
    assert [float(row["train/loss"]) for row in rows] == [1.0, 2.0]


def test_half_a_row_of_a_killed_run_is_dropped(tmp_path):
    log(tmp_path, 0, [(100, {"train/loss": 1.0}), (200, {"train/loss": 2.0})])
    path = tmp_path / "progress.csv"
    path.write_text(path.read_text()[:-3] + "\n300")
    log(tmp_path, 300, [(400, {"train/loss": 4.0})])
    assert [int(row[STEPS]) for row in read_csv(tmp_path)][-1] == 400
    assert "300" not in [row[STEPS] for row in read_csv(tmp_path)]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"time/total_timesteps,a\n1.5,2\n", "invalid literal"),
        (b"time/total_timesteps\xff", "can't decode"),
        (b"x" * 200_000, "field"),
    ],
)
def test_another_file_in_the_place_of_the_log_is_one_line_and_stays(tmp_path, content, why):
    path = tmp_path / "progress.csv"
    path.write_bytes(content)
    with pytest.raises(RunError, match=f"progress.csv: not the log of a training .*{why}"):
        make_logger(tmp_path, 100)
    assert path.read_bytes() == content


def test_a_run_from_the_start_replaces_the_rows(tmp_path):
    for value in (1.0, 2.0):
        log(tmp_path, 0, [(100, {"train/loss": value})])
    assert [row["train/loss"] for row in read_csv(tmp_path)] == ["2.0"]


@pytest.mark.parametrize("text", ["", "\n", "a,b\n1,2\n"])
def test_a_csv_without_transitions_is_begun_anew(tmp_path, text):
    (tmp_path / "progress.csv").write_text(text)
    log(tmp_path, 100, [(200, {"train/loss": 1.0})])
    assert [(row[STEPS], row["train/loss"]) for row in read_csv(tmp_path)] == [("200", "1.0")]


@pytest.mark.parametrize(("error", "is_printed"), [(OSError, False), (ValueError, True)])
def test_of_a_threads_errors_only_those_of_the_disk_are_silent(monkeypatch, error, is_printed):
    printed = []
    monkeypatch.setattr(threading, "excepthook", lambda args: printed.append(args.exc_type))
    hook = threading.excepthook

    def fail():
        raise error

    with quiet_writer_thread():
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
    assert printed == ([error] if is_printed else [])
    assert threading.excepthook is hook
