"""Protections of the samples of a gyro: rows 45 to 50 of docs/faults.md."""

from typing import Final

from tests.support.protections.protection import Protection

GYRO_PROTECTIONS: Final = (
    Protection(
        "45",
        "missing samples are counted",
        "onboard/wheels/gyro.py",
        "        self._missing += missing\n",
        "",
        test="counted",
    ),
    Protection(
        "45",
        "a turn over a gap is unknown to the map",
        "offline/measurements/motion_model/gyro.py",
        "return np.asarray(covered & (n_touching == 0))",
        "return np.asarray(covered)",
        test="the_map",
    ),
    Protection(
        "46",
        "samples that come twice or late are left out",
        "onboard/wheels/gyro.py",
        "if first_us + (n_samples - 1) * line.period_us <= before_us:",
        "if False:",
        test="repeated",
    ),
    Protection(
        "46",
        "the time of samples is compared with the wheels'",
        "onboard/wheels/gyro.py",
        "if expected_us is None or abs(first_us - expected_us) > _FARTHEST_US:",
        "if expected_us is None:",
        test="cannot_be",
    ),
    Protection(
        "46",
        "a sequence number that contradicts the clock is not believed",
        "onboard/wheels/gyro.py",
        "if not 0 <= sequence - next_sequence <= 2 * lost_by_time + _MISCOUNT:",
        "if False:",
        test="wrong_sequence",
    ),
    Protection(
        "47",
        "a sample that was not measured has no yaw rate",
        "onboard/wheels/gyro.py",
        "                continue\n            at_us",
        "                rate = 0\n            at_us",
    ),
    Protection(
        "48",
        "a value that stays the same is watched for",
        "onboard/recorder/losses.py",
        "elif not self._is_frozen and each.stamp_ns - self._same_since_ns >= _FROZEN_NS:",
        "elif False:",
    ),
    Protection(
        "48",
        "the map leaves out a value that stays the same",
        "offline/measurements/motion_model/gyro.py",
        "    if frozen.any():\n",
        "    if False:\n",
    ),
    Protection(
        "49",
        "a new epoch of the wheels is one of the gyro",
        "onboard/wheels/intake.py",
        "                self.gyro.begin_epoch()\n",
        "",
        test="begins_anew",
    ),
    Protection(
        "49",
        "samples of another boot are left out",
        "onboard/wheels/protocol.py",
        "if self._last is None or boot_id != self._wire_boot_id:",
        "if self._last is None:",
        test="another_boot",
    ),
    Protection(
        "49",
        "the time of samples is unwrapped",
        "onboard/wheels/gyro.py",
        "nearest(line.t_us, expected_us)",
        "line.t_us",
        test="wrap",
    ),
    Protection(
        "50",
        "silence of the gyro is watched for",
        "onboard/recorder/watches.py",
        "if self.gyro.fell_silent(now_ns):",
        "if False:",
        test="falls_silent",
    ),
)
