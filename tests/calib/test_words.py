"""Numbers in sentences."""

from groundsbot.calib.foundation.words import plural


def test_one_is_no_plural() -> None:
    assert [plural(n, "tag") for n in (0, 1, 2)] == ["0 tags", "1 tag", "2 tags"]
