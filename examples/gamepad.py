"""Fly with a gamepad. Needs pygame-ce: pip install pygame-ce.

python examples/gamepad.py udpin:0.0.0.0:14550

Left stick: throttle and yaw; right stick: forward and right. Release all sticks and the vehicle stays where it is.
Button 1 (B) ends the flight: the vehicle holds, the sticks are released, and it lands.
"""

# pyright: reportMissingImports=false
from __future__ import annotations

import asyncio
import sys
from typing import Protocol

import aerokit
from aerokit import StickInput

DEAD_ZONE = 0.08
END_BUTTON = 1


class Pad(Protocol):
    """The part of ``pygame.joystick.Joystick`` that this program uses."""

    def get_axis(self, number: int, /) -> float: ...

    def get_button(self, number: int, /) -> bool: ...


def read(pad: Pad) -> StickInput:
    """Return the stick positions; gamepads report down and right as positive."""

    def axis(number: int) -> float:
        value = max(-1.0, min(1.0, pad.get_axis(number)))
        return 0.0 if abs(value) < DEAD_ZONE else value

    return StickInput(forward=-axis(3), right=axis(2), throttle=-axis(1), yaw=axis(0))


def open_pad() -> Pad:
    """Return the first gamepad, read by pygame."""
    import pygame

    pygame.init()
    if not pygame.joystick.get_count():
        sys.exit("no gamepad found")

    class PumpedPad:
        def __init__(self) -> None:
            self._joystick = pygame.joystick.Joystick(0)

        def get_axis(self, number: int, /) -> float:
            pygame.event.pump()
            return float(self._joystick.get_axis(number))

        def get_button(self, number: int, /) -> bool:
            return bool(self._joystick.get_button(number))

    return PumpedPad()


async def main(address: str, pad: Pad) -> None:
    """Take off, fly by the pad until its button is pressed, and land."""
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        if vehicle.autopilot.name == "ArduPilot":
            await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(altitude_m=5)
        async with vehicle.sticks() as sticks:
            print(f"you have the sticks in {vehicle.mode_name}")
            while not pad.get_button(END_BUTTON):
                sticks.set(read(pad))
                await asyncio.sleep(0.04)
        print(f"sticks released in {vehicle.mode_name}")
        await vehicle.land()
        print("landed")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550", open_pad()))
