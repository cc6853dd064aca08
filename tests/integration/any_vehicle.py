"""The vehicle that `test_any_…` try and fly: simulated, at an address, or a binary that is started for it."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from free_ports import free_port
from vehicle_kinds import KINDS, Kind

from aerokit import Vehicle, connect
from aerokit.sim import SimulatedVehicle, SimulatorServer, open_simulator, simulated_link
from aerokit.sim.kinds import scale_timeouts, simulated
from aerokit.transport import Link, create_link, memory_link_pair

__all__ = ["Choice", "connected", "ready", "served", "served_on_two"]

SPEEDUP_BINARY = 5.0
LATENCY_S = 0.005
# Instance number of a binary; ArduPilot derives its ports from it.
INSTANCE = int(os.environ.get("AEROKIT_TEST_INSTANCE", "95"))


@dataclass(frozen=True)
class Choice:
    """The vehicle selected by the options; ``speedup`` is its speed relative to real time, 1 in virtual time."""

    vehicle: str
    kind: Kind
    speedup: float
    is_virtual: bool

    @classmethod
    def from_options(cls, config: pytest.Config) -> list[Choice]:
        """Read the options; raises UsageError for an address without ``--i-know-it-flies``."""
        vehicle, name = str(config.getoption("--vehicle")), config.getoption("--vehicle-kind")
        speedup = config.getoption("--vehicle-speedup")
        if vehicle == "sim":
            kinds = KINDS.values() if name is None else [KINDS[name]]
            return [cls(vehicle, kind, speedup or 1.0, speedup is None) for kind in kinds]
        if Path(vehicle).is_file():
            by_name = next((k for k in KINDS.values() if k.firmware == Path(vehicle).name), KINDS["copter"])
            return [cls(vehicle, by_name if name is None else KINDS[name], speedup or SPEEDUP_BINARY, False)]
        if not config.getoption("--i-know-it-flies"):
            raise pytest.UsageError(
                f"{vehicle} may be a real vehicle: motors will turn and it will fly; add --i-know-it-flies"
            )
        return [cls(vehicle, KINDS[name or "copter"], speedup or 1.0, False)]

    @property
    def is_binary(self) -> bool:
        """True if a firmware is started for each test."""
        return Path(self.vehicle).is_file()

    def seconds(self, simulated_s: float) -> float:
        """Convert seconds to a timeout by our clock, with a margin for a busy machine."""
        return simulated_s / self.speedup + (0.0 if self.is_virtual else 20.0)


@asynccontextmanager
async def connected(choice: Choice) -> AsyncIterator[Vehicle]:
    """Connect to the vehicle, which was just started unless it is at an address."""
    async with served(choice) as address, connect(address, timeout=30) as vehicle:
        yield vehicle


@asynccontextmanager
async def ready(choice: Choice) -> AsyncIterator[Vehicle]:
    """Ready to be armed."""
    async with connected(choice) as vehicle:
        await vehicle.wait_ready(timeout=choice.seconds(120))
        yield vehicle


def served(choice: Choice) -> AbstractAsyncContextManager[str | Link]:
    """The vehicle runs; gives what to connect to."""
    if choice.vehicle == "sim":
        return _simulated(choice)
    return _binary(choice) if choice.is_binary else _as_given(choice.vehicle)


@asynccontextmanager
async def served_on_two(choice: Choice) -> AsyncIterator[list[Link]]:
    """Run the vehicle with two ports; skips the test for a vehicle at an address."""
    if choice.vehicle == "sim":
        ours, theirs = zip(*(memory_link_pair() for _ in range(2)), strict=True)
        async with SimulatorServer(_patient(choice), theirs, speedup=choice.speedup):
            yield list(ours)
        return
    if not choice.is_binary:
        pytest.skip("one address is one link")
    second = 14550 if not choice.kind.is_ardupilot else free_port()
    more = ["--serial1", f"udpclient:127.0.0.1:{second}"] if choice.kind.is_ardupilot else []
    async with _binary(choice, more) as first:
        yield [create_link(first), create_link(f"udpin:127.0.0.1:{second}")]


@asynccontextmanager
async def _as_given(address: str) -> AsyncIterator[str]:
    yield address


@asynccontextmanager
async def _simulated(choice: Choice) -> AsyncIterator[str | Link]:
    vehicle = _patient(choice)
    if choice.is_virtual:
        async with simulated_link(vehicle, latency_s=LATENCY_S) as link:
            yield link
        return
    async with open_simulator(vehicle, "udpin:127.0.0.1:0", speedup=choice.speedup) as simulator:
        yield simulator.addresses[0].replace("udpin", "udpout")


def _patient(choice: Choice) -> SimulatedVehicle:
    latitude, longitude, altitude, heading = choice.kind.home
    vehicle = simulated(choice.kind.name, home=(latitude, longitude, altitude), heading_deg=heading)
    scale_timeouts([vehicle], choice.speedup)
    return vehicle


@asynccontextmanager
async def _binary(choice: Choice, more: Sequence[str] = ()) -> AsyncIterator[str]:
    """Start the binary in an empty directory, and terminate it afterwards."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        is_px4 = not choice.kind.is_ardupilot
        port = 14540 + min(INSTANCE, 9) if is_px4 else free_port()
        command, environment = _px4(choice) if is_px4 else _ardupilot(choice, port, Path(folder))
        with subprocess.Popen(  # noqa: ASYNC220 - it takes milliseconds
            [*command, *more], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as process:  # fmt: skip
            try:
                yield f"udpin:127.0.0.1:{port}"
            finally:
                process.terminate()


def _ardupilot(choice: Choice, port: int, folder: Path) -> tuple[list[str], dict[str, str]]:
    """Return command and environment; its time-outs are those of a simulated vehicle at the same speed."""
    binary, kind = Path(choice.vehicle).resolve(), choice.kind
    files = [folder / "patience.parm"]
    files[0].write_text("".join(f"{name} {value:g}\n" for name, value in _longer(choice).items()))
    source = next((folder for folder in binary.parents if (folder / "Tools/autotest").is_dir()), None)
    if source is not None:
        files.insert(0, source / "Tools/autotest" / kind.defaults)
    command = [str(binary), "--model", kind.model, "--speedup", f"{choice.speedup:g}", f"-I{INSTANCE}"]
    command += ["--home", ",".join(map(str, kind.home)), "--defaults", ",".join(map(str, files))]
    return [*command, "--serial0", f"udpclient:127.0.0.1:{port}"], {}


def _longer(choice: Choice) -> dict[str, float]:
    usual, patient = (simulated(choice.kind.name) for _ in range(2))
    scale_timeouts([patient], choice.speedup)
    before, after = usual.parameters, patient.parameters  # type: ignore[attr-defined]
    return {name: after[name] for name in after if after[name] != before[name]}


def _px4(choice: Choice) -> tuple[list[str], dict[str, str]]:
    """Start PX4, which uses 127.0.0.1:14540 and following; its data is beside the folder of the binary."""
    binary = Path(choice.vehicle).resolve()
    environment = {"PX4_SIM_MODEL": choice.kind.model, "PATH": "/usr/bin:/bin"}
    if choice.speedup != 1.0:
        environment["PX4_SIM_SPEED_FACTOR"] = f"{choice.speedup:g}"
    return [
        str(binary),
        "-d",
        "-i",
        f"{min(INSTANCE, 9)}",
        "-w",
        ".",
        str(binary.parents[1] / "etc"),
    ], environment
