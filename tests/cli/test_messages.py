import warnings

import pytest

from sb3_flock._renamed import RenamedWarning
from sb3_flock.cli.messages import errors_of, warnings_as_lines, written_to
from sb3_flock.settings import SettingsError


def test_warnings_are_one_line_each_shown_once_and_without_a_place_in_the_source(capsys):
    with warnings_as_lines():
        for _ in range(2):
            warnings.warn("the arena\n is small", RenamedWarning, stacklevel=1)
        warnings.warn_explicit("another", UserWarning, "file.py", 3, module="sb3_flock.evaluation")
    assert capsys.readouterr().err == "sb3-flock: warning: the arena is small\nsb3-flock: warning: another\n"


def test_warnings_of_other_packages_keep_their_filters():
    with warnings_as_lines(), pytest.raises(DeprecationWarning):  # an error in the tests
        warnings.warn("gone soon", DeprecationWarning, stacklevel=1)


def test_an_error_about_a_flags_value_names_the_flag():
    with pytest.raises(SettingsError, match="^--resume x: not there$"), errors_of("--resume", "x"):
        raise SettingsError("x: not there")
    with pytest.raises(SettingsError, match="^gamma = 2$"), errors_of("--resume", "x"):
        raise SettingsError("gamma = 2")
    with pytest.raises(SettingsError, match="^--output x: No space"), written_to("--output", "x"):
        raise OSError(28, "No space left on device")
    with pytest.raises(OSError, match="No space"), errors_of("--resume", "x"):
        raise OSError(28, "No space left on device")
