"""Makes recordings of flights complete: they contain the parameters, and the rest of the flight after a failure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.output import DONE, plain_text
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.events import SILENT_AFTER_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.apps.cli.terminal import InterruptStack
    from aerokit.vehicle.vehicle import Vehicle

# Over a slow radio, reading all parameters may take longer. The flight then begins without the remaining parameters.
_PARAMETERS_TIMEOUT_S = 10.0
MAX_SILENCE_S = 10.0
"""A recording ends after this many seconds without a heartbeat, because no more data is expected."""
_POLL_INTERVAL_S = 0.2
_MAX_STILL_S = 20.0
_MAX_DRIFT_M = 1.0
_MAX_HEIGHT_M = 3.0


async def record_parameters(vehicle: Vehicle, print_line: Callable[[str], None]) -> None:
    """Request all parameters, so that a report on the recording can explain failsafes.

    Gives up after 10 s.
    """
    try:
        # The faster MAVFTP is not used, because reports need a PARAM_VALUE message for each parameter.
        table = await vehicle.parameters.download(method="list", timeout=_PARAMETERS_TIMEOUT_S)
    except OperationTimeout:
        print_line(f"  the recording lacks parameters: not all were received within {_PARAMETERS_TIMEOUT_S:g} s")
    except AerokitError as error:  # the end of the connection, or a refusal
        print_line(f"  the recording lacks parameters: {plain_text(error)}")
    else:
        print_line(f"  {len(table)} parameters recorded")


async def record_to_end(
    vehicle: Vehicle, interrupts: InterruptStack, print_line: Callable[[str], None], speedup: float = 1.0
) -> None:
    """Stay connected to an armed vehicle until it is disarmed or silent for 10 s, or until Ctrl-C.

    Near the ground, the recording also ends after 20 s without motion, in simulated time.
    """
    if not vehicle.is_armed or not vehicle.connection.is_open:
        return
    if vehicle.heartbeat_age >= MAX_SILENCE_S:
        print_line(f"the recording ends after {MAX_SILENCE_S:g} s of silence; the vehicle was armed")
        return
    print_line(
        f"still armed: the recording goes on until the vehicle disarms, lies still for {_MAX_STILL_S:g} s,"
        f" is silent for {MAX_SILENCE_S:g} s, or Ctrl-C"
    )

    # A crashed vehicle may stay armed, so the wait ends if it lies still. `speedup` is above 1 in a fast simulation.
    stillness = _StillnessNearGround(vehicle, _MAX_STILL_S / speedup)

    async def wait() -> int:
        while vehicle.is_armed and vehicle.connection.is_open and vehicle.heartbeat_age < MAX_SILENCE_S:
            if stillness.has_lasted():
                break
            await anyio.sleep(_POLL_INTERVAL_S)
        return DONE  # `interrupts.run` returns None only after an interrupt

    reason = "interrupted" if await interrupts.run(wait) is None else "end of the recording"
    print_line(f"{reason}: {vehicle.describe_now()}")


class _StillnessNearGround:
    """Detects that a vehicle at about the height of its home has not moved for ``min_duration_s``."""

    def __init__(self, vehicle: Vehicle, min_duration_s: float) -> None:
        self._vehicle = vehicle
        self._min_duration_s = min_duration_s
        self._still_at = vehicle.position.latest
        self._still_since = vehicle.connection.now()

    def has_lasted(self) -> bool:
        """Evaluate the latest position, and return True if the vehicle has not moved for long enough.

        Call this method regularly.
        """
        now = self._vehicle.connection.now()
        position = self._vehicle.position.latest
        if position is None:
            return False
        is_old = self._vehicle.position.age > SILENT_AFTER_S
        has_moved = self._still_at is None or position.distance_to(self._still_at) > _MAX_DRIFT_M
        height_m = position.altitude_relative_m
        is_near_ground = height_m is not None and abs(height_m) <= _MAX_HEIGHT_M
        # Only a recent position near the ground can show that the vehicle lies still.
        if is_old or has_moved or not is_near_ground:
            self._still_at = position
            self._still_since = now
        return now - self._still_since >= self._min_duration_s
