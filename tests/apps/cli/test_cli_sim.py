"""``aerokit sim``: fleets, address templates, pseudo-terminals, pictures."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from recorded import SHORT

from aerokit import connect
from aerokit.apps.cli import main
from aerokit.apps.cli.arguments import DEFAULT_SIM_ADDRESS, FAULTS, expand_address, fault, is_address_template
from aerokit.apps.cli.main import make_parser
from aerokit.apps.cli.sim import _client_address, _emit_addresses, _inject_faults, simulated_fleet
from aerokit.errors import AerokitError
from aerokit.sim import HOME, SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sim.faults import Faults
from aerokit.testing import run_virtual
from aerokit.testing.track import true_point

DOCUMENTED_FAULTS = dict(
    re.findall(
        r"^\| `(\w+)` \| .*? \| (no|yes|it does not answer)\b.*\|$",
        (Path(__file__).parents[3] / "docs" / "simulator.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
)

# ---------------------------------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("form", "first", "third"),
    [
        (DEFAULT_SIM_ADDRESS, "tcpin:127.0.0.1:5760", "tcpin:127.0.0.1:5780"),
        ("udpout:127.0.0.1:{14550+n}", "udpout:127.0.0.1:14550", "udpout:127.0.0.1:14552"),
        ("pty:/tmp/ttyV{n}", "pty:/tmp/ttyV0", "pty:/tmp/ttyV2"),
        ("udpin:0.0.0.0:145{id}", "udpin:0.0.0.0:1457", "udpin:0.0.0.0:1459"),
    ],
)
def test_address_template_expands_for_each_vehicle(form: str, first: str, third: str) -> None:
    assert is_address_template(form)
    assert (expand_address(form, 0, 7), expand_address(form, 2, 9)) == (first, third)


def test_plain_address_is_no_template() -> None:
    assert not is_address_template("udpout:127.0.0.1:14550")
    assert expand_address("udpout:127.0.0.1:14550", 3, 4) == "udpout:127.0.0.1:14550"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--count", "0"],
        ["--count", "251"],
        ["tcpin:127.0.0.1:{99999+n}"],
        ["--wind", "3"],
        ["--wind", "1,2,-3"],
        ["--wind", "strong"],
        ["--battery", "120"],
        ["--picture", "track.gif"],
        ["--picture", "/no/such/directory/track.svg"],
        ["--vehicle", "submarine"],
    ],
    ids=" ".join,
)
def test_sim_invalid_arguments_exit_with_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["sim", *arguments])
    assert exit_.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_sim_system_ids_above_255_are_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--count", "10", "--system-id", "250"]) == 2
    assert "the maximum is 255" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------- fleets


def test_simulated_fleet_is_placed_in_row_eastwards() -> None:
    fleet = simulated_fleet("px4", 3, system_id=4, spacing_m=10.0, battery_percent=50.0)
    assert [vehicle.system_id for vehicle in fleet] == [4, 5, 6]
    places = [true_point(vehicle) for vehicle in fleet]
    assert [place.latitude_deg for place in places] == pytest.approx([HOME[0]] * 3)
    east = [(place.longitude_deg - places[0].longitude_deg) * 1e7 for place in places]
    assert east == pytest.approx([0, 1102, 2203], abs=1)  # 1 m is 110.2 times 1e-7 degrees there
    assert all(isinstance(vehicle, SimulatedPx4) and vehicle.battery.percent == 50 for vehicle in fleet)


def test_sim_unknown_option_or_recording_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--vehicle", "px4", "--parameter", "RTL_ALT=3000"]) == 2
    assert "the simulated vehicle has no parameter 'RTL_ALT'; similar names: " in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["sim", "--vehicle", "nowhere.tlog"])
    assert "recording 'nowhere.tlog' does not exist" in capsys.readouterr().err


def test_simulated_fleet_passes_options_to_vehicle() -> None:
    (copter,) = simulated_fleet("copter", 1, boot_text=True, boot_time_s=0.0, parameters={"RTL_ALT": 2000.0})
    assert isinstance(copter, SimulatedCopter)
    assert copter.parameters["RTL_ALT"] == 2000
    assert copter.timeline.ready == 0


def test_sim_after_duration_writes_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "track.svg"
    addresses = ["udpout:127.0.0.1:{45550+n}", "tcpin:127.0.0.1:0"]
    arguments = ["--count", "2", "--speedup", "100", "--duration", "5", "--picture", str(picture)]
    assert main(["sim", *addresses, *arguments]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("system 1 on udpout:127.0.0.1:45550")
    assert printed[1].startswith("system 2 on udpout:127.0.0.1:45551")
    assert printed[2].startswith("systems 1 to 2 on tcpin:127.0.0.1:")
    assert printed[3] == "try: aerokit demo --connect udpin:127.0.0.1:45550"
    assert printed[4].startswith("or:  aerokit status udpin:127.0.0.1:45550, ")
    assert printed[5:] == ["stopped", f"track written to {picture}"]
    assert picture.read_text().count("<polyline") == 4


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_sim_pty_prints_name_of_other_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "ttyV0"
    assert main(["sim", f"pty:{port}", "--speedup", "100", "--duration", "1"]) == 0
    assert f"try: aerokit demo --connect {port}\n" in capsys.readouterr().out
    assert not os.path.lexists(port)


@pytest.mark.parametrize(
    ("options", "client"),
    [
        ("", "zenoh://f/a"),
        ("?listen=tcp/0.0.0.0:7447", "'zenoh://f/a?connect=tcp/127.0.0.1:7447'"),
        (
            "?connect=tcp/10.0.0.5:7447&config=z.json5",
            "'zenoh://f/a?connect=tcp/10.0.0.5:7447&config=z.json5'",
        ),
    ],
)
def test_zenoh_client_address_connects_to_listening_endpoint(options: str, client: str) -> None:
    assert _client_address("zenohin://f/a", f"zenohin://f/a{options}") == client


def test_sim_hint_has_endpoint_of_first_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    template = "zenohin://f/v{id}?listen=tcp/0.0.0.0:{7440+id}"
    options = make_parser("sim").parse_args(["sim", template, "--system-id", "5"])
    server: Any = SimpleNamespace(addresses=["zenohin://f/v5"], vehicles_on=[[SimpleNamespace(system_id=5)]])
    _emit_addresses(server, options)
    assert "try: aerokit demo --connect 'zenoh://f/v5?connect=tcp/127.0.0.1:7445'\n" in capsys.readouterr().out


def test_negative_coordinates_are_parsed_as_values() -> None:
    options = make_parser("sim").parse_args(["sim", "--home", "-35.36,149.16,-2.5", "--wind", "-3,-.5"])
    assert options.home == (-35.36, 149.16, -2.5)
    assert options.wind == (-3.0, -0.5)


def test_sim_serves_recording(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(SHORT / "px4-quad.tlog")
    arguments = ["udpout:127.0.0.1:45560", "--speedup", "100", "--duration", "20", "--vehicle", path]
    assert main(["sim", *arguments]) == 0
    assert "system 1 on udpout:" in capsys.readouterr().out
    assert main(["sim", *arguments, "--count", "2"]) == 2
    assert main(["sim", *arguments, "--picture", "track.svg"]) == 2


# ------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("motor_failed@20", ("motor_failed", True, 20.0)),
        ("gps_lost", ("gps_lost", True, 0.0)),
        ("loss=0.2@5", ("loss", 0.2, 5.0)),
        ("prearm_failures=Compass not healthy", ("prearm_failures", ["Compass not healthy"], 0.0)),
    ],
)
def test_sim_fault_is_parsed_with_value_and_time(text: str, parsed: object) -> None:
    assert fault(text) == parsed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("motor_faild", r"not a fault \(did you mean 'motor_failed'\?\); faults: gps_lost, rc_lost, .*prearm_failures"),
        ("motor_failed=1", "motor_failed takes no value; motor_failed@5 begins after 5 simulated seconds"),
        ("loss", "loss needs the share of frames to lose: loss=0.2"),
        ("prearm_failures", "needs a reason"),
        ("gps_lost@soon", "'soon' is not a number"),
    ],
)
def test_sim_wrong_fault_error_says_what_is_allowed(
    text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["sim", "--fault", text])
    assert re.search(message, capsys.readouterr().err)


def test_sim_fault_begins_at_its_simulated_time() -> None:
    options = make_parser("sim").parse_args(
        ["sim", "--fault", "gps_lost@20", "--fault", "prearm_failures=No compass", "--speedup", "2"]
    )
    copters = [SimulatedCopter(), SimulatedCopter()]

    async def inject() -> list[bool]:
        task = asyncio.create_task(_inject_faults(copters, options))
        await anyio.sleep(9.9)
        early = any(copter.faults.gps_lost for copter in copters)
        await task
        return [early, *(copter.faults.gps_lost for copter in copters)]

    assert run_virtual(inject()) == [False, True, True]
    assert [copter.faults.prearm_failures for copter in copters] == [["No compass"]] * 2


def test_sim_faults_are_fields_and_documented() -> None:
    assert set(FAULTS) <= {field.name for field in dataclasses.fields(Faults)}
    document = (Path(__file__).parents[3] / "docs" / "simulator.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", document.partition("## Faults")[2].partition("\n## ")[0], re.M) == list(FAULTS)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", FAULTS)
def test_fault_refuses_arming_as_documented(name: str) -> None:
    values = {"prearm_failures": ["Compass not healthy"], "loss": 0.2, "loss_incoming": 0.2}

    async def scenario() -> bool:
        copter = SimulatedCopter(boot_time_s=0.0)
        async with simulated_link(copter) as link, connect(link) as vehicle:
            await vehicle.wait_ready()
            setattr(copter.faults, name, values.get(name, True))
            await anyio.sleep(10.0)
            with suppress(AerokitError):
                await vehicle.arm()
            return copter.is_armed

    assert run_virtual(scenario()) is (DOCUMENTED_FAULTS[name] == "no")


def test_lost_transmitter_was_on_for_a_second() -> None:
    """ArduPilot does not miss a transmitter that it has never received."""
    assert fault("rc_lost") == fault("rc_lost@0.3") == ("rc_lost", True, 1.0)
    assert fault("rc_lost@5") == ("rc_lost", True, 5.0)
    assert fault("gps_lost") == ("gps_lost", True, 0.0)
