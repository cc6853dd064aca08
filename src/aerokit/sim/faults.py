"""What can go wrong with a simulated vehicle on demand: one object with plain attributes and a few verbs."""

from __future__ import annotations

from dataclasses import dataclass, field

from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.message import Message


@dataclass
class CommandFault:
    """How one command is mistreated; ``times`` counts down, None is for ever."""

    times: int | None = None
    refuse_with: int | None = None
    """This MAV_RESULT instead of doing it."""
    text: str | None = None
    """A status text that goes out with the refusal."""
    ignore: bool = False
    """Neither done nor answered."""
    acks: int = 1
    """How many answers are sent: 0 loses the answer, 2 repeats it."""
    delay_s: float = 0.0
    """The answer comes this much later; the deed is done at once."""
    progress: tuple[int, ...] = ()
    """IN_PROGRESS answers with these percentages come first."""
    progress_interval_s: float = 0.5


@dataclass
class Faults:
    """Everything is off at first. Change attributes at any time; they act from the next message or step on.

    - ``gps_lost``: no GPS fix any more; after seven seconds the estimator gives its position up
    - ``rc_lost``: the pilot's transmitter is off; what follows is up to the failsafes of the kind
    - ``leak``: there is water in the hull of a submarine
    - ``heartbeats_stopped``: every stream goes on, heartbeats do not
    - ``frozen``: the autopilot hangs; it neither hears, moves nor sends until it is False again
    - ``silent``: the radio is out; nothing gets through in either direction, the vehicle flies on
    - ``prearm_failures``: reasons that the arming checks give besides the real ones ("Compass not healthy")
    - ``drop_outgoing``, ``drop_incoming``: this many of the next frames are lost (they count down)
    - ``loss``, ``loss_incoming``: share of the outgoing and of the incoming frames that is lost at random, 0 to 1, the
      same for the same seed
    - ``lost_messages``: message id → how many of the next ones of this kind are lost on their way out; see ``lose``
    - ``motor_failed``: a motor stands still; the vehicle cannot hold its height and comes down
    - ``no_ftp``: FILE_TRANSFER_PROTOCOL is neither answered nor among the capabilities
    - ``parameter_limits``: name → lowest and highest value; what is set is clamped to them without a word
    - ``read_only_parameters``: names whose values cannot be set
    - ``mute_parameters``: names whose PARAM_VALUE never gets through
    """

    gps_lost: bool = False
    rc_lost: bool = False
    leak: bool = False
    heartbeats_stopped: bool = False
    frozen: bool = False
    silent: bool = False
    prearm_failures: list[str] = field(default_factory=list)
    drop_outgoing: int = 0
    drop_incoming: int = 0
    loss: float = 0.0
    loss_incoming: float = 0.0
    lost_messages: dict[int, int] = field(default_factory=dict)
    motor_failed: bool = False
    no_ftp: bool = False
    parameter_limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    read_only_parameters: set[str] = field(default_factory=set)
    mute_parameters: set[str] = field(default_factory=set)
    commands: dict[int, CommandFault] = field(default_factory=dict)

    def refuse(
        self,
        command: int,
        result: int = MavResult.DENIED,
        text: str | None = None,
        *,
        times: int | None = None,
    ) -> None:
        """Answer a MAV_CMD with this MAV_RESULT, and a status text before it, instead of doing it."""
        self.commands[command] = CommandFault(times, refuse_with=result, text=text)

    def ignore(self, command: int, *, times: int | None = None) -> None:
        """Neither do nor answer a MAV_CMD."""
        self.commands[command] = CommandFault(times, ignore=True)

    def lose_ack(self, command: int, *, times: int | None = 1) -> None:
        """Do it, but lose the answer."""
        self.commands[command] = CommandFault(times, acks=0)

    def lose(self, message_type: type[Message], *, times: int = 1) -> None:
        """Have the next messages of a kind lost on their way out."""
        self.lost_messages[message_type.ID] = times

    def loses(self, message: Message) -> bool:
        """Whether this one is lost; counts down."""
        left = self.lost_messages.get(message.ID, 0)
        if left:
            self.lost_messages[message.ID] = left - 1
        return left > 0

    def repeat_ack(self, command: int, count: int = 2, *, times: int | None = None) -> None:
        """Do it and answer several times."""
        self.commands[command] = CommandFault(times, acks=count)

    def delay_ack(self, command: int, seconds: float, *, times: int | None = None) -> None:
        """Do it at once and answer later."""
        self.commands[command] = CommandFault(times, delay_s=seconds)

    def report_progress(
        self, command: int, percents: tuple[int, ...] = (10, 50, 90), *, interval_s: float = 0.5
    ) -> None:
        """Answer IN_PROGRESS at these percentages before the result, one every ``interval_s`` seconds."""
        self.commands[command] = CommandFault(progress=percents, progress_interval_s=interval_s)

    def clear(self, command: int | None = None) -> None:
        """Treat one command, or every command, properly again."""
        if command is None:
            self.commands.clear()
        else:
            self.commands.pop(command, None)

    def take(self, command: int) -> CommandFault | None:
        """What to do to this command now; counts ``times`` down."""
        fault = self.commands.get(command)
        if fault is not None and fault.times is not None:
            fault.times -= 1
            if fault.times <= 0:
                del self.commands[command]
        return fault
