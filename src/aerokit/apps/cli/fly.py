"""``aerokit fly``: upload a plan, arm the vehicle, and fly the mission."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, cast

import anyio

from aerokit import events
from aerokit._internal.formatting import format_value
from aerokit.apps.cli.arguments import add_conditions, add_number, add_record, conditions, vehicle_kind
from aerokit.apps.cli.completion import kinds, set_completions
from aerokit.apps.cli.connecting import add_vehicle, connect_to, default_address, signing_of
from aerokit.apps.cli.flight_recording import record_parameters, record_to_end
from aerokit.apps.cli.mission import PARTS, add_max_distance, begins_with_take_off, emit_items, read_plan, upload_parts
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, add_json, emit, new_recording
from aerokit.apps.cli.supervised_flight import INTERRUPT_ACTIONS, FlightReport, SupervisedFlight
from aerokit.apps.cli.terminal import InterruptStack, confirm, is_interactive, on_interrupt
from aerokit.errors import AerokitError, InvalidArgument, NotSupported, OperationRejected
from aerokit.vehicle.missions.mission import END_GRACE_S

if TYPE_CHECKING:
    import argparse

    from aerokit.apps.cli.supervised_flight import Purpose
    from aerokit.missions import MissionItem, Plan
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

_MAX_START_DISTANCE_M = 1000.0
_SIM_BOOT_TIME_S = 2.0
_NOTHING_SENT = "nothing was sent"


class PlanFlight(SupervisedFlight):
    """Flies the mission of a plan."""

    _prints_reasons = False

    def __init__(
        self,
        vehicle: Vehicle,
        plan: Plan,
        report: FlightReport,
        interrupts: InterruptStack,
        options: argparse.Namespace,
    ) -> None:
        super().__init__(vehicle, report, interrupts, options.on_interrupt)
        self._plan = plan
        self._options = options
        self.sent_text: str = _NOTHING_SENT
        """Text about what was sent to the vehicle before arming, for the message after Ctrl-C."""

    async def _fly(self) -> int:
        vehicle = self._vehicle
        self._print(f"found {vehicle.autopilot.firmware}, system {vehicle.system_id}")
        self._check_vehicle()
        self.sent_text = "the upload was not completed, nothing was armed"
        await upload_parts(vehicle, self._plan, self._options)
        self.sent_text = "the plan is on the vehicle, nothing was armed"
        # Another ground station may change the mission before the start. It cannot reach a vehicle that this program
        # simulates.
        uploaded_mission = () if self._options.sim else await self._download_mission()
        if self._options.record is not None:
            await record_parameters(vehicle, self._print)
        self._print("waiting until the vehicle is ready")
        await vehicle.wait_ready(timeout=self._options.ready)
        for warning in self._warnings():
            self._print(f"  ! {warning}")
        if not await self._is_confirmed():
            self._print("not confirmed; nothing was started")
            return FAILED
        self._check_disarmed()  # once more, because the user may have taken long to answer
        if not self._options.sim and await self._download_mission() != uploaded_mission:
            raise OperationRejected("the mission on the vehicle changed after the upload; nothing was started")
        self._print("arming")
        await self._arm()
        progress = asyncio.create_task(self._print_progress())
        try:
            self._print("armed; starting the mission")
            await vehicle.mission.start()
            self._has_changed_mode = True
            await vehicle.mission.wait_finished()
        finally:
            progress.cancel()
            await asyncio.wait({progress})
        return await self._finish()

    async def _download_mission(self) -> tuple[MissionItem, ...]:
        return tuple((await self._vehicle.mission.download(idle_timeout_s=self._options.patience)).items)

    def _check_vehicle(self) -> None:
        vehicle = self._vehicle
        interrupt_action = self._options.on_interrupt
        self._check_disarmed()
        possible_actions = [action for action in INTERRUPT_ACTIONS if action == "nothing" or self._has_mode_for(action)]
        if interrupt_action not in possible_actions:
            raise NotSupported(
                f"{vehicle.autopilot.firmware} has no mode for --on-interrupt {interrupt_action}: choose"
                f" {' or '.join(possible_actions)}; nothing was sent"
            )
        mission = self._plan.mission
        mission.check(home_is_item_0=vehicle.autopilot.home_is_item_0)
        if vehicle.autopilot.mission_needs_take_off and not begins_with_take_off(mission.items):
            raise InvalidArgument(
                f"the mission does not begin with a take-off: {vehicle.autopilot.firmware} on the ground refuses to"
                " start it; nothing was sent"
            )

    def _has_mode_for(self, purpose: str) -> bool:
        mode_for = self._vehicle.autopilot.mode_for
        return mode_for(cast("Purpose", purpose), is_vtol=self._vehicle.is_vtol) is not None

    def _warnings(self) -> list[str]:
        items = self._plan.mission.items
        warnings = []
        first_position = next((item.position for item in items if item.position is not None), None)
        if first_position is not None:
            distance = self._vehicle.distance_to(first_position)
            if distance > _MAX_START_DISTANCE_M:
                warnings.append(f"the first waypoint is {distance / 1000:.1f} km away")
        # Not just "LAND": the last item may be DO_LAND_START, which does not land.
        if not any(part in items[-1].name for part in ("NAV_LAND", "NAV_VTOL_LAND", "RETURN_TO_LAUNCH")):
            warnings.append(
                "the mission does not end with a landing or return: the vehicle stays at its last waypoint, or returns"
                " to launch (ArduPlane)"
            )
        return warnings

    async def _is_confirmed(self) -> bool:
        if self._options.sim or self._options.yes:
            return True
        vehicle = self._vehicle
        name = f"{vehicle.autopilot.firmware}, system {vehicle.system_id}"
        self._report.prints_status = False
        try:
            return await confirm(f"arm {name}, and fly {len(self._plan.mission)} items?")
        finally:
            self._report.prints_status = True

    async def _print_progress(self) -> None:
        async with anyio.create_task_group() as group:
            with (
                self._vehicle.subscribe(events.MissionCurrentChanged, events.ModeChanged, capacity=100) as changes,
                suppress(AerokitError),  # the end of the connection, which also ends the flight
            ):
                async for event in changes:
                    if isinstance(event, events.ModeChanged):
                        group.start_soon(self._explain_wait, event.after)
                    elif isinstance(event, events.MissionCurrentChanged) and event.after is not None:
                        self._print(f"to item {event.after}{self._name_of(event.after)}")
            group.cancel_scope.cancel()

    async def _explain_wait(self, mode: str) -> None:
        """Print how long the flight waits for the end of the mission after a change to ``mode``."""
        delay_s = END_GRACE_S / 4  # Nothing is printed about a mode that the vehicle leaves within this time.
        await anyio.sleep(delay_s)
        vehicle = self._vehicle
        is_unexplained = vehicle.mode_name == mode and not self._is_in_our_mode and not vehicle.mission.explains_mode
        if self._has_changed_mode and is_unexplained:
            # END_GRACE_S is real time. The printed time is that of the vehicle, which is longer in a fast simulation.
            seconds = format_value(self._report.speedup * (END_GRACE_S - delay_s))
            self._print(f"waiting {seconds} s for the end of {mode} or a report that the mission has ended")

    def _name_of(self, index: int) -> str:
        items = self._plan.mission.items
        return f", {items[index].name}" if index < len(items) else ""

    async def _finish(self) -> int:
        vehicle = self._vehicle
        await self._wait_disarmed_on_ground()
        self._print(f"mission finished: {vehicle.describe_now()}")
        emit(self._options, "flown", {"system_id": vehicle.system_id, "armed": vehicle.is_armed}, text=None)
        return DONE

    def _our_purposes(self) -> tuple[Purpose, ...]:
        # The purposes "land" and "return" are left out, because a failsafe may have set their modes. "hold" is the
        # purpose of the mode after a cancelled start of the mission.
        return ("mission",) if self._has_changed_mode else ("mission", "hold")


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("file", metavar="FILE", help=".plan (QGroundControl), or a file that begins with QGC WPL 110")
    command.add_argument("--yes", action="store_true", help="do not ask before arming")
    command.add_argument(
        "--on-interrupt",
        choices=tuple(INTERRUPT_ACTIONS),
        default="return",
        help="what the vehicle does after Ctrl-C in the air; a second Ctrl-C exits without it (default: return)",
    )
    add_number(command, "--ready", 0, 3600, "S", "seconds to wait until the vehicle is ready to arm", default=120.0)
    add_max_distance(command)
    simulated = command.add_argument_group("simulated")
    simulated.add_argument(
        "--sim", action="store_true", help="fly on a simulated vehicle at the planned home; does not ask"
    )
    kind = simulated.add_argument(
        "--vehicle", type=vehicle_kind, metavar="KIND", help="copter, plane, px4 … (default: the plan's vehicle type)"
    )
    set_completions(kind, kinds)
    add_number(simulated, "--speedup", 0.1, 100, "X", "simulation speed factor", default=10.0)
    add_conditions(simulated)
    add_record(command)
    add_vehicle(command)
    add_json(command)
    # `run_fly` fills in the default address, because it must know whether --connect is given.
    command.set_defaults(run=run_fly, connect=None)
    # argparse has no public list of a group's options.
    command.set_defaults(simulation_actions=tuple(simulated._group_actions))


async def run_fly(options: argparse.Namespace) -> int:
    plan = read_plan(options.file)
    _check_arguments(options, plan)
    for part in PARTS:
        items = getattr(plan, part).to_items()
        if items:
            emit_items(options, part, items, state="in the file")
    # `_connect_and_fly` appends the flight, so that this function knows its state after an interrupt.
    flights: list[PlanFlight] = []
    interrupts = InterruptStack()
    with on_interrupt(interrupts.interrupt):
        code = await interrupts.run(lambda: _connect_and_fly(options, plan, interrupts, flights))
    if code is None:
        code = INTERRUPTED
    if code == INTERRUPTED and not any(flight.has_sent_arm_command for flight in flights):
        sent_text = flights[-1].sent_text if flights else _NOTHING_SENT
        emit(options, "interrupted", {}, f"interrupted; {sent_text}")
    return code


def _check_arguments(options: argparse.Namespace, plan: Plan) -> None:
    if not plan.mission.items:
        raise InvalidArgument(f"{options.file} has no mission items, so there is nothing to fly")
    if options.sim and options.connect is not None:
        raise InvalidArgument("--sim and --connect cannot be used together")
    for action in options.simulation_actions:
        if getattr(options, action.dest) != action.default and not options.sim:
            raise InvalidArgument(f"{action.option_strings[0]} needs --sim")
    if not (options.sim or options.yes or is_interactive()):
        raise InvalidArgument(
            "cannot ask for confirmation, because stdin is not a terminal; --yes omits the question; nothing was sent"
        )


async def _connect_and_fly(
    options: argparse.Namespace, plan: Plan, interrupts: InterruptStack, flights: list[PlanFlight]
) -> int:
    async with AsyncExitStack() as stack:
        stack.enter_context(new_recording(options.record))
        link: str | Link = options.connect or default_address()
        if options.sim:
            link = await _start_simulation(options, plan, stack)
        address = link if isinstance(link, str) else link.address
        if not options.sim:
            emit(options, "connecting", {"address": address}, f"connecting to {address}")
        signing = None if options.sim else signing_of(options)
        vehicle = await stack.enter_async_context(
            connect_to(options, link, changes_vehicle=not options.sim, signing=signing, record=options.record)
        )
        report = FlightReport(vehicle, options, speedup=options.speedup if options.sim else 1.0)
        flight = PlanFlight(vehicle, plan, report, interrupts, options)
        flights.append(flight)
        error: AerokitError | None = None
        async with report.running():
            try:
                code = await flight.fly()
                # The recording of a real vehicle continues until the end of the flight. A simulated vehicle may stay in
                # the air after its mission, because nobody lands it, so its recording might not end.
                continues_recording = code == DONE and not options.sim
            except AerokitError as flight_error:  # raised again below, after the summary
                error = flight_error
                code = FAILED
                # After an error, a failsafe may land even a simulated vehicle, which the recording should contain.
                continues_recording = True
            if continues_recording and flight.has_sent_arm_command and options.record is not None:
                await record_to_end(vehicle, interrupts, report.print_line, report.speedup)
        if flight.has_sent_arm_command:
            report.print_summary(options.record)
        if error is not None:
            raise error
    return code


async def _start_simulation(options: argparse.Namespace, plan: Plan, stack: AsyncExitStack) -> Link:
    from aerokit.apps.cli.sim import injecting_faults
    from aerokit.sim import simulated_link
    from aerokit.sim.kinds import scale_timeouts, simulated
    from aerokit.sim.motion import HOME

    kind = options.vehicle or _kind_for(plan)
    positions = [plan.mission.home, *(item.position for item in plan.mission.items)]
    start = next((position for position in positions if position is not None), None)
    latitude_deg, longitude_deg, altitude_m = HOME
    if start is not None:
        latitude_deg, longitude_deg = start.latitude_deg, start.longitude_deg
        if start.altitude_amsl_m is not None:
            altitude_m = start.altitude_amsl_m
    home = (latitude_deg, longitude_deg, altitude_m)
    vehicle = simulated(kind, home=home, boot_time_s=_SIM_BOOT_TIME_S, **conditions(options))
    scale_timeouts([vehicle], options.speedup, leave=dict(options.parameters))
    link = await stack.enter_async_context(simulated_link(vehicle, speedup=options.speedup))
    await stack.enter_async_context(injecting_faults([vehicle], options))
    record = {"system_ids": [vehicle.system_id], "address": link.address, "speedup": options.speedup}
    text = f"simulated {kind} at {latitude_deg:.6f}, {longitude_deg:.6f}, speed {options.speedup:g}x"
    emit(options, "simulated", record, text)
    return link


def _kind_for(plan: Plan) -> str:
    from aerokit.mavlink.enums import MavAutopilot, MavType

    vtols = range(MavType.VTOL_TAILSITTER_DUOROTOR, MavType.VTOL_RESERVED5 + 1)
    is_plane = plan.vehicle_type == MavType.FIXED_WING or plan.vehicle_type in vtols
    if plan.firmware_type == MavAutopilot.PX4:
        return "px4_plane" if is_plane else "px4"
    if is_plane:
        return "plane"
    if plan.vehicle_type in (MavType.GROUND_ROVER, MavType.SURFACE_BOAT):
        return "rover"
    return "sub" if plan.vehicle_type == MavType.SUBMARINE else "copter"
