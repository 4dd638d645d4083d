"""The log reader given broken files: a short, seeded form of `tests.benchmarks.faults.fuzz`."""

import pytest

from groundsbot.onboard.log.reading import chunks
from tests.support.guided_fuzz import fuzz
from tests.support.log_reader_fuzz import TARGET, check


@pytest.mark.parametrize("seed", [1, 2])
def test_no_broken_file_gives_a_wrong_message(seed: int) -> None:
    done = fuzz(TARGET, seed, runs=150)
    assert len(done.corpus) > len(TARGET.seeds)  # it got somewhere


def test_the_fuzz_test_detects_a_checksum_that_is_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = TARGET.seeds[1]
    at = plain.index(b"recording_started")
    check(plain)
    changed = plain[:at] + b"R" + plain[at + 1 :]
    check(changed)
    monkeypatch.setattr(chunks, "zlib", _NoChecksums)
    with pytest.raises(AssertionError, match="no whole chunk holds"):
        check(changed)


class _NoChecksums:
    @staticmethod
    def crc32(_data: bytes, _before: int = 0) -> "_Any":
        return _Any()


class _Any(int):
    def __eq__(self, _other: object) -> bool:
        return True

    def __ne__(self, _other: object) -> bool:
        return False

    __hash__ = int.__hash__
