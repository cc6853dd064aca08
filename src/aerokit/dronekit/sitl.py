"""What ``import dronekit_sitl`` means in programs that :mod:`aerokit.dronekit` runs: simulated vehicles of aerokit.

Nothing is downloaded; the vehicle flies in a thread of this process, and ends with it. What is answered is what the
package dronekit-sitl 3.3 has: ``start_default``, ``SITL``, ``version_list``.
"""

from __future__ import annotations

import argparse
import asyncio
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.util import errprinter
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.sim.kinds import simulated, wait_longer
from aerokit.sim.local_frame import HOME
from aerokit.sim.server import open_simulator

if TYPE_CHECKING:
    from collections.abc import Sequence

KINDS = {"copter": "copter", "solo": "copter", "plane": "plane", "rover": "rover", "sub": "sub"}
"""What dronekit-sitl calls its vehicles, and what they are here."""
START_TIMEOUT_S = 30.0
USUAL_ADDRESSES = ("tcpin:127.0.0.1:5760", "udpout:127.0.0.1:14550")

_instances = 0
_given: ServedVehicle | None = None


class ServedVehicle:
    """A simulated vehicle on addresses, in a thread of its own, until :meth:`stop` or the end of the process."""

    def __init__(
        self,
        kind: str,
        addresses: Sequence[str],
        *,
        home: tuple[float, float, float] = HOME,
        speedup: float = 1.0,
    ) -> None:
        self.kind: str = kind
        self.speedup: float = speedup
        self.addresses: tuple[str, ...] = ()
        """Where it is, as the simulator spells it."""
        self._vehicle = simulated(kind, home=home)
        self._asked = tuple(addresses)
        self._error: Exception | None = None
        self._is_up = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="aerokit simulated vehicle", daemon=True)
        self._thread.start()
        if not self._is_up.wait(START_TIMEOUT_S):
            raise LinkOpenError(f"the simulated vehicle has not started within {START_TIMEOUT_S:g} s")
        self._raise_what_failed()

    def _raise_what_failed(self) -> None:
        if self._error is not None:
            self._thread.join()
            raise self._error

    @property
    def is_up(self) -> bool:
        """Whether it flies."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Switch it off; nothing happens the second time."""
        if self._thread.is_alive():
            with suppress(RuntimeError):  # it ends at this very moment
                self._loop.call_soon_threadsafe(self._over.set)
            self._thread.join()

    def wait(self) -> None:
        """Until it is switched off."""
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:
            if self._is_up.is_set():
                errprinter(f"the simulated vehicle has failed: {error!r}")
            self._error = error
        finally:
            self._loop.close()
            self._is_up.set()

    async def _serve(self) -> None:
        wait_longer([self._vehicle], self.speedup)
        async with open_simulator([self._vehicle], *self._asked, speedup=self.speedup) as simulator:
            self.addresses = tuple(simulator.addresses)
            self._is_up.set()
            await self._over.wait()


def serve_for_program(kind: str, home: tuple[float, float, float], speedup: float) -> ServedVehicle:
    """Serve a vehicle where DroneKit programs look for one; a program that starts one itself puts it in its place.

    Raises:
        InvalidArgument: there is no such kind.
        LinkOpenError: no address could be opened.
    """
    global _given
    try:
        _given = ServedVehicle(kind, USUAL_ADDRESSES, home=home, speedup=speedup)
    except LinkOpenError as error:
        errprinter(f"{error}; another port is taken")
        free = ("tcpin:127.0.0.1:0", *USUAL_ADDRESSES[1:])
        _given = ServedVehicle(kind, free, home=home, speedup=speedup)
    return _given


class SITL:
    """A simulated ArduPilot vehicle as dronekit-sitl starts one; ``path``, gdb and valgrind say nothing here."""

    def __init__(self, path: str | None = None, instance: int | None = None, *_: Any, **__: Any) -> None:
        global _instances
        self.path = path
        if instance is None:
            instance, _instances = _instances, _instances + 1
        self.instance: int = instance
        self._kind: str | None = None
        self._served: ServedVehicle | None = None

    def download(self, system: str, version: str, target: str | None = None, verbose: bool = False) -> None:
        """Note which vehicle it is; there is nothing to be fetched, and ``version`` is the simulator's own."""
        if system not in KINDS:
            raise InvalidArgument(f"dronekit_sitl: system = {system!r} is not one of: {', '.join(KINDS)}")
        self._kind = KINDS[system]

    def launch(
        self,
        initial_args: Sequence[str],
        verbose: bool = False,
        await_ready: bool = False,
        restart: bool = False,
        wd: str | None = None,
        use_saved_data: bool = False,
        speedup: float | None = None,
    ) -> None:
        """Start it. Of SITL's arguments ``--home``, ``--speedup``, ``--model`` and ``-I`` are understood.

        Raises:
            ChildProcessError: it runs already, and ``restart`` is not set.
            LinkOpenError: its port is taken.
        """
        global _given
        if self._served is not None and self._served.is_up:
            if not restart:
                raise ChildProcessError(
                    "SITL is already running in this process, please use .stop() to kill it"
                )
            self.stop()
        options = _arguments().parse_known_args(list(initial_args))[0]
        if options.instance is not None:
            self.instance = options.instance
        kind, addresses = self._kind or KINDS.get(options.model or "", "copter"), [self._port()]
        if _given is not None:
            kind = (self._kind and kind) or _given.kind
            speedup = speedup or options.speedup or _given.speedup
            addresses += USUAL_ADDRESSES[1:]
            _given.stop()
            _given = None
        home = parse_home(options.home) if options.home else HOME
        self._served = ServedVehicle(kind, addresses, home=home, speedup=speedup or options.speedup or 1.0)

    def poll(self) -> int | None:
        """None while it runs."""
        return None if self._served is not None and self._served.is_up else 0

    def stop(self) -> None:
        """Switch it off."""
        if self._served is not None:
            self._served.stop()

    def block_until_ready(self, verbose: bool = False) -> int | None:
        """It is ready for a connection once :meth:`launch` has returned."""
        return self.poll()

    def complete(self, verbose: bool = False) -> None:
        """Wait until somebody stops it."""
        while self.poll() is None:
            time.sleep(0.1)

    def connection_string(self) -> str:
        """What ``dronekit.connect`` takes."""
        return self._port().replace("tcpin:", "tcp:")

    def _port(self) -> str:
        return f"tcpin:127.0.0.1:{5760 + 10 * self.instance}"


def start_default(lat: float | None = None, lon: float | None = None) -> SITL:
    """Start a copter, at home near Canberra or at this place; InvalidArgument for one of the two alone."""
    if (lat is None) != (lon is None):
        raise InvalidArgument("dronekit_sitl.start_default: give both lat and lon, or neither")
    sitl = SITL()
    sitl.launch([] if lat is None else [f"--home={lat:f},{lon:f},{HOME[2]},353"])
    return sitl


def version_list() -> dict[str, dict[str, str]]:
    """Systems, each with the one version that there is."""
    return {system: {"stable": "aerokit"} for system in KINDS}


def parse_home(text: str) -> tuple[float, float, float]:
    """``LAT,LON,ALT`` or SITL's ``LAT,LON,ALT,HEADING``; InvalidArgument for anything else."""
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(",")[:3])
    except ValueError:
        raise InvalidArgument(f"home = {text!r} is not LAT,LON,ALT in degrees and metres") from None
    return latitude, longitude, altitude


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--home", "-O")
    parser.add_argument("--speedup", "-s", type=float)
    parser.add_argument("--model", "-M")
    parser.add_argument("-I", "--instance", dest="instance", type=int)
    return parser
