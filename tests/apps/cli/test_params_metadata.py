"""`aerokit params … --metadata`: values are checked before they are sent; units and meanings are shown."""

from __future__ import annotations

import json
import lzma
from pathlib import Path

import pytest
from cli_harness import records, run_with
from component_calls import GENERAL

from aerokit.apps.cli import params_metadata
from aerokit.sim import SimulatedCopter, SimulatedPx4

FIELDS = {
    "RTL_ALT": {"DisplayName": "Altitude", "Description": "", "Units": "cm", "Range": {"low": "200", "high": "8000"}},
    "FS_THR_ENABLE": {
        "DisplayName": "Failsafe",
        "Description": "",
        "Values": {"0": "Disabled", "1": "Enabled always RTL"},
        "RebootRequired": "True",
    },
}


@pytest.fixture
def metadata(tmp_path: Path) -> str:
    path = tmp_path / "apm.pdef.json"
    path.write_text(json.dumps({"": FIELDS}))
    return str(path)


@pytest.mark.parametrize("value", ["RTL_ALT=-99999", "rtl_alt=9000", "FS_THR_ENABLE=99", "RTL_ALT_M=90"])
def test_set_outside_range_is_refused(value: str, metadata: str, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    before = copter.parameters["RTL_ALT"], copter.parameters["FS_THR_ENABLE"]
    assert run_with(copter, ["params", "set", value, "LOG_BITMASK=1", "--metadata", metadata]) == [2]
    assert (copter.parameters["RTL_ALT"], copter.parameters["FS_THR_ENABLE"]) == before
    printed = capsys.readouterr()
    assert printed.out == ""
    assert value.partition("=")[0] in printed.err
    assert "nothing was set; --force sets these values nevertheless" in printed.err


def test_set_outside_range_with_force_is_set(metadata: str, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    assert run_with(copter, ["params", "set", "RTL_ALT=9000", "--metadata", metadata, "--force"]) == [0]
    assert copter.parameters["RTL_ALT"] == 9000


@pytest.mark.parametrize(
    ("value", "options", "note"),
    [
        (
            "RTL_ALT=-99999",
            (),
            "RTL_ALT          1500 → -99999 set\nranges were not",
        ),
        ("LOG_BITMASK=1", ("--metadata",), "set range not checked (the metadata does not have this parameter)\n"),
        ("RTL_ALT=2000", ("--metadata",), "RTL_ALT          1500 → 2000  set\n"),
    ],
)
def test_set_says_that_range_was_not_checked(
    value: str, options: tuple[str, ...], note: str, metadata: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = (*options, metadata) if options else ()
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "set", value, *given]) == [0]
    assert note in (out := capsys.readouterr().out)
    assert ("https://autotest.ardupilot.org/Parameters/ArduCopter/apm.pdef.xml" in out) is not bool(options)


def test_set_names_reboot_of_metadata(metadata: str, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    assert run_with(copter, ["params", "set", "FS_THR_ENABLE=0", "--metadata", metadata]) == [0]
    assert "takes effect after a reboot" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::aerokit.parameters.ParameterRenamedWarning")
@pytest.mark.parametrize("name", ["MAV_SYSID", "sysid_thismav"])
def test_set_system_id_names_next_steps(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "set", f"{name}=3"]) == [0]
    assert "at the next reboot at the latest; then connect with --system-id 3" in capsys.readouterr().out


def test_load_outside_range_is_refused(metadata: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    file = tmp_path / "mine.param"
    file.write_text("RTL_ALT,9000\nFS_THR_ENABLE,0\n")
    load = ["params", "load", str(file), "--metadata", metadata]
    assert run_with(copter, load, [*load, "--force"], load) == [2, 0, 0]  # the last one finds nothing to change
    assert copter.parameters["RTL_ALT"] == 9000
    assert "RTL_ALT = 9000 is not in 200..8000 cm" in capsys.readouterr().err


@pytest.mark.parametrize(("line", "has_note"), [("NO_SUCH,1", False), ("RTL_ALT,2000", True)])
def test_load_without_writes_does_not_mention_ranges(
    line: str, has_note: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.param"
    file.write_text(f"{line}\n")
    run_with(SimulatedCopter(boot_time_s=0.0), ["params", "load", str(file)])
    assert ("ranges were not checked" in capsys.readouterr().out) is has_note


def test_get_and_list_show_metadata(metadata: str, capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    get = ["params", "get", "RTL_ALT", "FS_THR_ENABLE", "--metadata", metadata]
    assert run_with(copter, get) == [0]
    first, second = capsys.readouterr().out.splitlines()
    assert first == "RTL_ALT          1500          cm, range 200 to 8000"
    assert second == "FS_THR_ENABLE    1             Enabled always RTL"
    assert run_with(copter, ["params", "list", "rtl_alt", "--metadata", metadata, "--json"]) == [0]
    (record,) = [each for each in records(capsys.readouterr().out) if each["name"] == "RTL_ALT"]
    assert (record["unit"], record["minimum"], record["maximum"], record["meaning"]) == ("cm", 200, 8000, None)


def test_px4_values_are_checked_with_metadata_of_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    px4 = SimulatedPx4(boot_time_s=0.0)
    entry = {"type": 1, "uri": "mftp://etc/extras/parameters.json"}
    px4.files.put(GENERAL, lzma.compress(json.dumps({"version": 1, "metadataTypes": [entry]}).encode()))
    altitude = {"name": "MIS_TAKEOFF_ALT", "type": "Float", "min": 0, "max": 80, "units": "m"}
    px4.files.put("/etc/extras/parameters.json", json.dumps({"version": 1, "parameters": [altitude]}).encode())
    wrong = ["params", "set", "MIS_TAKEOFF_ALT=-5000"]
    assert run_with(px4, wrong, ["params", "set", "MIS_TAKEOFF_ALT=20"], [*wrong, "--force"]) == [2, 0, 0]
    assert "MIS_TAKEOFF_ALT = -5000 is not in 0..80 m" in capsys.readouterr().err


def test_px4_without_answer_says_that_ranges_are_unchecked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(params_metadata, "_READ_TIMEOUT_S", 0.0)
    assert run_with(SimulatedPx4(boot_time_s=0.0), ["params", "set", "MIS_TAKEOFF_ALT=20"]) == [0]
    assert "the ranges of the values are not checked" in capsys.readouterr().err


def test_diff_names_sides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.param"
    file.write_text("RTL_ALT,9000\nNOT_THERE,3\n")
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "diff", str(file)]) == [1]
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first == "RTL_ALT          vehicle 1500, file 9000"
    assert second == "NOT_THERE        vehicle does not have it, file 3"


def test_get_unknown_name_prints_one_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedCopter(boot_time_s=0.0), ["params", "get", "NOSUCH"]) == [5]
    (line,) = capsys.readouterr().err.splitlines()
    assert "NOSUCH" in line
    assert "`aerokit params list` shows all names" in line


def test_changed_without_reported_defaults_uses_metadata(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """PX4 does not report defaults, but its metadata has them."""
    file, vehicle = tmp_path / "parameters.json", SimulatedPx4(boot_time_s=0.0)
    defaults = {"RTL_RETURN_ALT": 12.5, "RTL_DESCEND_ALT": vehicle.parameters["RTL_DESCEND_ALT"]}
    entries = [{"name": name, "type": "Float", "default": value} for name, value in defaults.items()]
    file.write_text(json.dumps({"version": 1, "parameters": entries}))
    assert run_with(vehicle, ["params", "list", "--changed", "--metadata", str(file)]) == [0]
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("RTL_RETURN_ALT")
    assert "(default 12.5)" in line


def test_changed_without_any_defaults_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedPx4(boot_time_s=0.0), ["params", "list", "--changed"]) != [0]
    err = capsys.readouterr().err
    assert "PX4 does not report the defaults of its parameters: --metadata FILE has them" in err
    assert "aerokit params diff FILE" in err


def test_set_of_misspelt_name_on_px4_suggests_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_with(SimulatedPx4(boot_time_s=0.0), ["params", "set", "RTL_RETRUN_ALT=40"]) == [5]
    assert "(did you mean 'RTL_RETURN_ALT'?)" in capsys.readouterr().out
