"""A key for signing, on every vehicle: set, used, not changeable while armed, removed. See `test_any_vehicle`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from any_vehicle import Choice, ready

from aerokit import Signing, SigningKey
from aerokit import messages as m
from aerokit.errors import OperationRejected, OperationTimeout
from aerokit.mavlink.signing import Refusal
from aerokit.testing import VIRTUAL_BACKEND

pytestmark = pytest.mark.anyio

KEY, OTHER = SigningKey.from_passphrase("one"), SigningKey.from_passphrase("another")
REQUEST_MESSAGE, AUTOPILOT_VERSION = 512, 148


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


@pytest.fixture(autouse=True)
def _skip_on_real_vehicle(choice: Choice) -> None:
    if choice.vehicle != "sim" and not Path(choice.vehicle).is_file():
        pytest.skip("a test that ends too soon would leave its key there")


async def test_signing_key_is_installed(choice: Choice) -> None:
    """PX4 accepts a key over USB only, and its simulation has no USB port."""
    async with ready(choice) as vehicle:
        signing = Signing(KEY)
        if choice.vehicle != "sim" and not choice.kind.is_ardupilot:
            with pytest.raises(OperationTimeout, match="PX4 accepts a signing key only on its USB port"):
                await vehicle.setup_signing(signing, timeout=choice.seconds(10))
            return
        await vehicle.setup_signing(signing, timeout=choice.seconds(10))
        try:
            await vehicle.command(REQUEST_MESSAGE, AUTOPILOT_VERSION)
            with vehicle.subscribe(m.Heartbeat) as heartbeats:
                frame = (await heartbeats.get()).received_frame
            assert frame is not None
            assert signing.has_signed(frame)
            await vehicle.arm()
            with pytest.raises(OperationRejected, match="armed"):
                await vehicle.setup_signing(Signing(OTHER))
            vehicle.send(m.SetupSigning(vehicle.system_id, 1, OTHER.secret, signing.timestamp))
            await vehicle.status_text.wait_until(
                lambda status: "signing" in status.text and "armed" in status.text, timeout=choice.seconds(5)
            )
            await vehicle.disarm()
        finally:
            await vehicle.setup_signing(None, timeout=choice.seconds(10))
        await vehicle.command(REQUEST_MESSAGE, AUTOPILOT_VERSION)
        assert signing.refused[Refusal.UNSIGNED] == signing.refused[Refusal.WRONG_SIGNATURE] == 0
