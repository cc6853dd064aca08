"""Adds a simulated camera to a running simulated vehicle."""

from __future__ import annotations

from typing import Any

from call_stage import Stage

from aerokit.sim import SimulatedCamera
from aerokit.sim.components.camera import DEFINITION_PATH, own_definition
from aerokit.sim.faults import Faults
from aerokit.vehicle.components.settings import Settings

__all__ = ["camera_of", "settings_of"]


def camera_of(stage: Stage) -> SimulatedCamera:
    """Return the camera of the vehicle, reset except for its uptime. Add it on first use."""
    simulated: Any = stage.simulated
    camera = next((component for component in simulated.components if isinstance(component, SimulatedCamera)), None)
    if camera is None:
        camera = SimulatedCamera()
        camera.join(simulated)
        simulated.components = (*simulated.components, camera)
    camera.faults = Faults()
    camera.files.put(DEFINITION_PATH, own_definition())
    camera.definition_uri = f"mftp://{DEFINITION_PATH}"
    camera.parameters.reset()
    camera.parameters.slow.clear()
    return camera


def settings_of(stage: Stage) -> Settings:
    """Return the settings of the camera."""
    return stage.vehicle.component(100).settings
