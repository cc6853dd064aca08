"""Simulated vehicles for DroneKit programs, with the interface of the package dronekit-sitl 3.3.

Provides ``start_default``, ``SITL`` and ``version_list``. Downloads nothing; vehicles run in threads of this process.
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
from aerokit.sim.kinds import scale_timeouts, simulated
from aerokit.sim.motion import HOME
from aerokit.sim.server import open_simulator

if TYPE_CHECKING:
    from collections.abc import Sequence

# Maps the vehicle names of dronekit-sitl to the simulator's names.
KINDS = {"copter": "copter", "solo": "copter", "plane": "plane", "rover": "rover", "sub": "sub"}
START_TIMEOUT_S = 30.0
TCP_ADDRESS, UDP_ADDRESS = "tcpin:127.0.0.1:5760", "udpout:127.0.0.1:14550"

_next_instance = 0  # instance number of the next SITL object that is created without one
_vehicle_for_program: ServedVehicle | None = None  # the vehicle that --sim has started before the program


class ServedVehicle:
    """A simulated vehicle that runs in a separate thread and is served on several addresses.

    It runs until :meth:`stop` is called or the process exits.
    """

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
        """Addresses in the simulator's form, such as ``tcpin:127.0.0.1:5760``."""
        # Everything below is used by the thread, so the thread is started last.
        self._vehicle = simulated(kind, home=home)
        self._requested_addresses = tuple(addresses)
        self._error: Exception | None = None  # error that ended the thread
        self._startup_ended = threading.Event()  # set when the vehicle is served, or when the start has failed
        self._loop = asyncio.new_event_loop()
        self._stop_requested = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="aerokit simulated vehicle", daemon=True)
        self._thread.start()
        if not self._startup_ended.wait(START_TIMEOUT_S):
            self._loop.call_soon_threadsafe(self._stop_requested.set)  # ends the thread if it starts later
            raise LinkOpenError(f"the simulated vehicle has not started within {START_TIMEOUT_S:g} s")
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            self._thread.join()
            raise self._error

    @property
    def is_up(self) -> bool:
        return self._thread.is_alive()

    def stop(self) -> None:
        if self._thread.is_alive():
            with suppress(RuntimeError):  # The loop may have just ended.
                self._loop.call_soon_threadsafe(self._stop_requested.set)
            self._thread.join()

    def wait(self) -> None:
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:
            if self._startup_ended.is_set():  # An error before the end of the startup is raised by `__init__`.
                errprinter(f"the simulated vehicle failed: {error!r}")
            self._error = error
        finally:
            self._loop.close()
            self._startup_ended.set()

    async def _serve(self) -> None:
        scale_timeouts([self._vehicle], self.speedup)
        async with open_simulator([self._vehicle], *self._requested_addresses, speedup=self.speedup) as simulator:
            self.addresses = tuple(simulator.addresses)
            self._startup_ended.set()
            await self._stop_requested.wait()


def serve_for_program(kind: str, home: tuple[float, float, float], speedup: float) -> ServedVehicle:
    """Serve a vehicle on DroneKit's usual addresses until the program starts another vehicle.

    Raises:
        InvalidArgument: the kind is unknown.
        LinkOpenError: no address could be opened.
    """
    global _vehicle_for_program
    try:
        _vehicle_for_program = ServedVehicle(kind, (TCP_ADDRESS, UDP_ADDRESS), home=home, speedup=speedup)
    except LinkOpenError as error:
        errprinter(f"{error}; using another port")
        addresses = ("tcpin:127.0.0.1:0", UDP_ADDRESS)  # The system chooses the TCP port.
        _vehicle_for_program = ServedVehicle(kind, addresses, home=home, speedup=speedup)
    return _vehicle_for_program


class SITL:
    """A simulated ArduPilot vehicle with the interface of dronekit-sitl. Ignores ``path`` and debugger options."""

    def __init__(self, path: str | None = None, instance: int | None = None, *_: Any, **__: Any) -> None:
        global _next_instance
        self.path = path
        if instance is None:
            instance = _next_instance
            _next_instance += 1
        self.instance: int = instance
        self._kind: str | None = None  # None selects the kind of the --sim vehicle, or a copter without --sim
        self._served: ServedVehicle | None = None  # None before launch()

    def download(self, system: str, version: str, target: str | None = None, verbose: bool = False) -> None:
        """Select the kind of vehicle. Downloads nothing; ``version`` is ignored."""
        if system not in KINDS:
            raise InvalidArgument(
                f"dronekit_sitl: system = {system!r} is not allowed: it must be one of {', '.join(KINDS)}"
            )
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
        """Start the vehicle. Supports SITL's arguments ``--home``, ``--speedup``, ``--model`` and ``-I``.

        Raises:
            ChildProcessError: the vehicle is already running, and ``restart`` is false.
            LinkOpenError: the port is in use.
        """
        global _vehicle_for_program
        if self._served is not None and self._served.is_up:
            if not restart:
                raise ChildProcessError("SITL is already running in this process, please use .stop() to kill it")
            self.stop()
        options, _ = _sitl_options().parse_known_args(list(initial_args))
        if options.instance is not None:
            self.instance = options.instance
        kind = self._kind or KINDS.get(options.model or "")
        speedup = speedup or options.speedup
        addresses = [self._address()]
        # The new vehicle replaces that of --sim, whose kind and speed are the defaults.
        if _vehicle_for_program is not None:
            kind = kind or _vehicle_for_program.kind
            speedup = speedup or _vehicle_for_program.speedup
            addresses.append(UDP_ADDRESS)
            _vehicle_for_program.stop()
            _vehicle_for_program = None
        home = parse_home(options.home) if options.home else HOME
        self._served = ServedVehicle(kind or "copter", addresses, home=home, speedup=speedup or 1.0)

    def poll(self) -> int | None:
        """Return None while the vehicle runs, 0 otherwise."""
        return None if self._served is not None and self._served.is_up else 0

    def stop(self) -> None:
        if self._served is not None:
            self._served.stop()

    def block_until_ready(self, verbose: bool = False) -> int | None:
        """Return the result of :meth:`poll` at once, because a launched vehicle is ready."""
        return self.poll()

    def complete(self, verbose: bool = False) -> None:
        while self.poll() is None:
            time.sleep(0.1)

    def connection_string(self) -> str:
        """Return the address for ``dronekit.connect``."""
        return self._address().replace("tcpin:", "tcp:")

    def _address(self) -> str:
        return f"tcpin:127.0.0.1:{5760 + 10 * self.instance}"  # the port of SITL with `-I INSTANCE`


def start_default(lat: float | None = None, lon: float | None = None) -> SITL:
    """Start a copter near Canberra or at this position; InvalidArgument if only one coordinate is given."""
    if (lat is None) != (lon is None):
        raise InvalidArgument("dronekit_sitl.start_default needs either both lat and lon or neither")
    sitl = SITL()
    _, _, altitude_amsl_m = HOME
    heading_deg = 353  # The format of SITL's --home requires a heading, which is ignored.
    sitl.launch([] if lat is None else [f"--home={lat:f},{lon:f},{altitude_amsl_m},{heading_deg}"])
    return sitl


def version_list() -> dict[str, dict[str, str]]:
    return {system: {"stable": "aerokit"} for system in KINDS}


def parse_home(text: str) -> tuple[float, float, float]:
    """Parse ``LAT,LON,ALT``. Further parts, such as SITL's heading, are ignored."""
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(",")[:3])
    except ValueError:
        raise InvalidArgument(f"home = {text!r} is not allowed: it must be LAT,LON,ALT in degrees and metres") from None
    return latitude, longitude, altitude


def _sitl_options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--home", "-O")
    parser.add_argument("--speedup", "-s", type=float)
    parser.add_argument("--model", "-M")
    parser.add_argument("-I", "--instance", dest="instance", type=int)
    return parser
