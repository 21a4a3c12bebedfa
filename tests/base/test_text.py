from wlr_gym.base.text import counted, duration, number


def test_numbers_have_three_digits():
    values = (0.041249, 5312.4, 12.0, 1e-7, -0.5, float("nan"))
    assert [number(value) for value in values] == ["0.0412", "5312", "12", "1e-07", "-0.5", "-"]


def test_times_have_two_units():
    assert [duration(seconds) for seconds in (59.4, 200.0, 3600.0, 7530.0, 360_000.0)] == [
        "59 s", "3 min 20 s", "1 h 0 min", "2 h 5 min", "100 h 0 min"
    ]  # fmt: skip


def test_one_is_not_many():
    assert [counted(count, "trial") for count in (0, 1, 2)] == ["0 trials", "1 trial", "2 trials"]
