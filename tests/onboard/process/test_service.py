"""The systemd unit of docs/robot: it may do what a recorder needs and little more."""

import re
import shutil
import subprocess

import pytest

from tests.support.paths import ROOT

UNIT = ROOT / "docs" / "robot" / "groundsbot-recorder.service"
# What systemd-analyze asks for and a recorder can do without.
TIGHT = {
    "CapabilityBoundingSet": "",
    "LockPersonality": "yes",
    "NoNewPrivileges": "yes",
    "PrivateNetwork": "yes",
    "PrivateTmp": "yes",
    "ProcSubset": "pid",
    "ProtectControlGroups": "yes",
    "ProtectHome": "yes",
    "ProtectHostname": "yes",
    "ProtectKernelLogs": "yes",
    "ProtectKernelModules": "yes",
    "ProtectKernelTunables": "yes",
    "ProtectProc": "invisible",
    "ProtectSystem": "strict",
    "RestrictAddressFamilies": "AF_UNIX",
    "RestrictNamespaces": "yes",
    "RestrictRealtime": "yes",
    "RestrictSUIDSGID": "yes",
    "SystemCallArchitectures": "native",
    "UMask": "0027",
}


def test_the_unit_has_what_makes_it_tight() -> None:
    settings = dict(re.findall(r"^(\w+)=(.*)$", UNIT.read_text(encoding="utf-8"), flags=re.MULTILINE))
    assert {name: settings.get(name) for name in TIGHT} == TIGHT
    assert "char-video4linux rw" in UNIT.read_text(encoding="utf-8")  # and the devices that it is for


def test_systemd_says_that_the_unit_is_tight() -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed here; the test above holds the settings it asks for")
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(UNIT)]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    if "unrecognized option" in said.stderr:
        pytest.skip("this systemd-analyze is older than version 250; the test above holds the settings it asks for")
    (level,) = re.findall(r"Overall exposure level for \S+: (\d+\.\d)", said.stdout)
    assert float(level) < 2.0
