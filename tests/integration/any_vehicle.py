"""The vehicle that `test_any_vehicle` flies: simulated, at an address, or a binary that is started for it."""

from __future__ import annotations

import socket
import subprocess
import tempfile
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from aerokit.sim import SimulatedCopter, SimulatedPx4, open_simulator

__all__ = ["Choice", "served"]

SPEEDUP_SIM, SPEEDUP_BINARY = 10.0, 5.0
HOME = "47.397742,8.545594,488,0"


@dataclass(frozen=True)
class Choice:
    """What the options say; ``speedup`` is how much faster than real time it is."""

    vehicle: str
    kind: str
    speedup: float

    @classmethod
    def from_options(cls, config: pytest.Config) -> Choice:
        """Raises UsageError for an address without ``--i-know-it-flies``."""
        vehicle, kind = str(config.getoption("--vehicle")), str(config.getoption("--vehicle-kind"))
        default = 1.0
        if vehicle == "sim":
            default = SPEEDUP_SIM
        elif Path(vehicle).is_file():
            default = SPEEDUP_BINARY
            kind = "px4" if "px4" in Path(vehicle).name else kind
        elif not config.getoption("--i-know-it-flies"):
            raise pytest.UsageError(
                f"{vehicle} may be a real vehicle: motors will turn and it will fly; add --i-know-it-flies"
            )
        return cls(vehicle, kind, float(config.getoption("--vehicle-speedup") or default))

    @property
    def is_simulated_here(self) -> bool:
        return self.vehicle == "sim"

    def seconds(self, simulated: float) -> float:
        """As a deadline by our clock, with room for a busy machine."""
        return simulated / self.speedup + 20.0


def served(choice: Choice) -> AbstractAsyncContextManager[str]:
    """The vehicle runs; gives the address to connect to."""
    if choice.is_simulated_here:
        return _simulated(choice)
    if Path(choice.vehicle).is_file():
        return _binary(choice)
    return _given(choice.vehicle)


@asynccontextmanager
async def _given(address: str) -> AsyncIterator[str]:
    yield address


@asynccontextmanager
async def _simulated(choice: Choice) -> AsyncIterator[str]:
    vehicle = SimulatedPx4() if choice.kind == "px4" else SimulatedCopter()
    async with open_simulator(vehicle, "udpin:127.0.0.1:0", speedup=choice.speedup) as simulator:
        yield simulator.addresses[0].replace("udpin", "udpout")


@asynccontextmanager
async def _binary(choice: Choice) -> AsyncIterator[str]:
    """It is started in an empty directory, and ended afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        port = 14545 if choice.kind == "px4" else _free_port()
        command, environment = _px4(choice) if choice.kind == "px4" else _ardupilot(choice, port)
        with subprocess.Popen(  # noqa: ASYNC220 - it takes milliseconds
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as process:  # fmt: skip
            try:
                yield f"udpin:127.0.0.1:{port}"
            finally:
                process.terminate()


def _ardupilot(choice: Choice, port: int) -> tuple[list[str], dict[str, str]]:
    binary = Path(choice.vehicle).resolve()
    command = [str(binary), "--model", "+", "--speedup", f"{choice.speedup:g}", "--home", HOME, "-I50"]
    source = next((each for each in binary.parents if (each / "Tools/autotest").is_dir()), None)
    if source is not None:
        command += ["--defaults", str(source / "Tools/autotest/default_params/copter.parm")]
    return [*command, "--serial0", f"udpclient:127.0.0.1:{port}"], {}


def _px4(choice: Choice) -> tuple[list[str], dict[str, str]]:
    """Instance 5 speaks to 127.0.0.1:14545; its data is beside the folder of the binary."""
    binary = Path(choice.vehicle).resolve()
    environment = {"PX4_SIM_MODEL": "sihsim_quadx", "PATH": "/usr/bin:/bin"}
    if choice.speedup != 1.0:
        environment["PX4_SIM_SPEED_FACTOR"] = f"{choice.speedup:g}"
    return [str(binary), "-d", "-i", "5", "-w", ".", str(binary.parents[1] / "etc")], environment


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
