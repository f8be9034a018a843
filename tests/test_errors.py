from sb3_flock import settings
from sb3_flock.errors import RunError, SettingsError, UserError


def test_an_error_is_one_printable_line_of_bounded_length():
    message = str(UserError("bad\nname \x1b[31m" + "x" * 10_000))
    assert message.isprintable()
    assert message.startswith("bad?name ?[31mx")
    assert len(message) == 2000


def test_an_error_about_several_parameters_keeps_one_message_for_each():
    error = SettingsError("gamma = 2", "tau = 0")
    assert error.parts == ("gamma = 2", "tau = 0")
    assert str(error) == "gamma = 2; tau = 0"


def test_the_settings_offer_the_same_errors():
    assert (settings.RunError, settings.SettingsError, settings.UserError) == (RunError, SettingsError, UserError)
