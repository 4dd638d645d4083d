"""The systemd unit of docs/robot: it may do what a recorder needs and little more."""

import re
import shutil
import subprocess
from ipaddress import ip_network
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "robot" / "page.conf"
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


def test_the_page_opens_the_unit_to_private_networks_only() -> None:
    settings = re.findall(r"^(\w+)=(.*)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert [name for name, _ in settings] == [
        *("ExecStart", "ExecStart", "PrivateNetwork", "IPAddressAllow", "RestrictAddressFamilies")
    ]
    allowed = dict(settings)["IPAddressAllow"].split()
    assert {"localhost", "link-local"} < set(allowed)
    assert all(ip_network(each).is_private for each in allowed if each[0].isdigit() or ":" in each)
    # What it runs is what the unit runs, with a page.
    (unit,) = re.findall(r"^ExecStart=(.*\\\n.*)$", UNIT.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert f"ExecStart={unit} --page 0.0.0.0:8080\n" in PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("with_page", [False, True])
def test_systemd_says_that_the_unit_is_tight(tmp_path: Path, with_page: bool) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed here; the tests above hold the settings it asks for")
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text(encoding="utf-8"), encoding="utf-8")
    if with_page:
        unit.write_text(f"{unit.read_text(encoding='utf-8')}\n{PAGE.read_text(encoding='utf-8')}", encoding="utf-8")
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    if "unrecognized option" in said.stderr:
        pytest.skip("this systemd-analyze is older than version 250; the tests above hold the settings it asks for")
    (level,) = re.findall(r"Overall exposure level for \S+: (\d+\.\d)", said.stdout)
    assert float(level) < 2.0
