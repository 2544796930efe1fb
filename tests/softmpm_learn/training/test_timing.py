"""Times of the parts of a run, as the log says them."""

from softmpm_learn.training.timing import account, duration


def test_the_parts_add_up_to_the_whole():
    seconds = {
        "episode": 45.2,
        "record": 12.6,
        "evaluate": 96.0,
        "learn": 2.0,
        "save": 0.4,
        "draw": 5.4,
        "end": 13.0,
    }
    assert account(seconds, 180.0) == (
        "The run took 3.0 min: episodes 45 s (13 s of it recording), evaluations 1.6 min, learning 2 s, pictures 5 s, the best motion "
        "13 s, all else 18 s."
    )


def test_what_took_no_time_is_left_out():
    assert account({"episode": 3.0, "record": 0.2}, 3.0) == "The run took 3 s: episodes 3 s."
    assert account({}, 0.2) == "The run took 0 s."


def test_long_durations_are_in_minutes():
    assert [duration(seconds) for seconds in (0.0, 89.4, 90.0)] == ["0 s", "89 s", "1.5 min"]
