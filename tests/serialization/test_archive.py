import io
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from sb3_flock.serialization.archive import MAX_CURVES, MAX_TEXT, check_size, read_curves, read_member, read_text


def npz(path, members):
    """A file as ``numpy.savez`` writes it, packed."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content if isinstance(content, bytes) else stored(content))
    return path


def stored(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), allow_pickle=True)
    return file.getvalue()


def test_curves_are_read_as_numpy_wrote_them(tmp_path):
    curves = {"score": np.array([0.5, np.nan]), "timesteps": np.array([10, 20])}
    np.savez(tmp_path / "curves.npz", **curves)
    read = read_curves(tmp_path / "curves.npz")
    assert set(read) == set(curves)
    for name, array in curves.items():
        np.testing.assert_array_equal(read[name], array)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.array(["2", "3"]), "score.npy holds <U1 where numbers are needed"),
        (np.array(["2024-01-01"], "datetime64[D]"), r"score.npy holds datetime64\[D\] where numbers"),
        (np.array([True]), "score.npy holds bool where numbers"),
        (np.array([{}], object), "score.npy|Object arrays"),
        (b"no array", "magic|NPY|Expected"),
    ],
)
def test_curves_of_anything_but_numbers_are_refused(content, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_curves(npz(tmp_path / "curves.npz", {"score": content}))


def test_what_all_members_together_unpack_to_is_bounded(tmp_path):
    """Each member is below the limit, their sum is not."""
    path = npz(tmp_path / "curves.npz", {f"metric_{i}": np.zeros(MAX_CURVES // 8 // 5) for i in range(6)})
    assert path.stat().st_size < MAX_CURVES / 100
    with pytest.raises(ValueError, match=rf"it unpacks to \d+ bytes: at most {MAX_CURVES} are read"):
        read_curves(path)
    with zipfile.ZipFile(path) as archive:
        check_size(archive, 2 * MAX_CURVES)
        assert len(read_member(archive, "metric_0.npy", MAX_CURVES)) > MAX_CURVES // 6


def test_an_array_that_is_smaller_than_its_header_says_takes_no_memory(tmp_path):
    resource = pytest.importorskip("resource", reason="limits of POSIX")
    content = stored(np.zeros(8)).replace(b"(8,)", b"(9999999999,)".ljust(4))
    path = npz(tmp_path / "curves.npz", {"score": content})
    code = f"from pathlib import Path; from sb3_flock.serialization.archive import read_curves; read_curves(Path({str(path)!r}))"

    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, preexec_fn=limit, check=False)
    assert "ValueError" in done.stderr.splitlines()[-1]


def test_a_text_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_bytes(b"a" * MAX_TEXT)
    assert len(read_text(path)) == MAX_TEXT
    path.write_bytes(b"a" * (MAX_TEXT + 1))
    with pytest.raises(ValueError, match=f"it has more than {MAX_TEXT} bytes"):
        read_text(path)
    path.write_bytes(b"\xff")
    with pytest.raises(ValueError, match="utf-8"):
        read_text(path)
