"""The asynchronous classes that have a blocking twin, and their members as found in the source code."""

from __future__ import annotations

import ast
import copy
import importlib
import inspect
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, ForwardRef, get_args, get_origin

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


@dataclass(frozen=True)
class Twin:
    """A blocking class to generate, the twin of an asynchronous class.

    Attributes:
        path: dotted path of the asynchronous class, with its module.
        base: the hand-written base class in ``blocks.py``.
        inherits: another generated twin, the base class of this one; inherited members are not generated again.
        only: generate only these members.
        without: do not generate these members.
        special: generate these dunder methods, too.
        direct: methods to call on the caller's thread, because they only read.
        read_on_loop: properties to read on the loop at each access.
        parts: properties to read on the loop once, because the first access creates their value.
        parameter: type argument of the base class.
        page: the file that it is written to.
    """

    path: str
    base: str = "TwinOf"
    inherits: str = ""
    only: frozenset[str] = frozenset()
    without: frozenset[str] = frozenset()
    special: frozenset[str] = frozenset()
    direct: frozenset[str] = frozenset()
    read_on_loop: frozenset[str] = frozenset()
    parts: frozenset[str] = frozenset()
    parameter: str = ""
    page: str = "twins"

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def module(self) -> str:
        return self.path.rpartition(".")[0]


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


# All classes to generate (twins). A class comes after those that its members return.
TWINS = (
    Twin(
        "aerokit.connection.cells.StateCell",
        "CellTwin",
        without=_names("observe set forget close"),
        direct=_names("fresh"),
        parameter="T",
    ),
    Twin("aerokit.connection.cells.Changes", "ChangesTwin", parameter="T"),
    Twin("aerokit.connection.bus.Subscription", "SubscriptionTwin", parameter="ItemT"),
    Twin(
        "aerokit.connection.connection.Connection",
        "ConnectionTwin",
        only=_names("send subscribe link_state links signing unsent_bytes discard_unsent is_open now counts"),
        direct=_names("now"),
        read_on_loop=_names("unsent_bytes"),
    ),
    Twin("aerokit.vehicle.commanding.guided.SetpointStream", "StreamTwin", parameter="SetpointT"),
    Twin("aerokit.vehicle.commanding.guided.Guided"),
    Twin("aerokit.vehicle.commanding.follow.FollowStream", "BlockTwin", read_on_loop=_names("target distance_m")),
    Twin("aerokit.vehicle.commanding.sticks.StickStream", "BlockTwin"),
    Twin("aerokit.vehicle.external.streams.MeasurementStream", "MeasurementTwin", parameter="MeasurementT"),
    Twin("aerokit.vehicle.external.external.External"),
    Twin("aerokit.vehicle.gimbal.control.GimbalControl", "BlockTwin"),
    Twin("aerokit.vehicle.gimbal.rates.GimbalRates", "BlockTwin"),
    Twin("aerokit.vehicle.gimbal.gimbal.Gimbal", read_on_loop=_names("device_id")),
    Twin("aerokit.vehicle.gimbal.gimbal.Gimbals", "GimbalsTwin", read_on_loop=_names("ids"), parameter='"Gimbal"'),
    Twin("aerokit.vehicle.commanding.posted.PostedOrder"),
    Twin("aerokit.vehicle.files.files.Files"),
    Twin("aerokit.vehicle.files.log_stream.LogStream", "LogStreamTwin"),
    Twin("aerokit.vehicle.files.logs.Logs"),
    Twin("aerokit.vehicle.devices.actuators.Actuators"),
    Twin("aerokit.vehicle.devices.gripper.Gripper"),
    Twin("aerokit.vehicle.devices.winch.Winch"),
    Twin("aerokit.vehicle.devices.shell.Shell", "BlockTwin"),
    Twin("aerokit.vehicle.parameters.transaction.TemporaryParameters", "TemporarilyTwin"),
    Twin("aerokit.vehicle.parameters.transaction.Transaction", "TransactionTwin"),
    Twin("aerokit.vehicle.parameters.parameters.Parameters", direct=_names("load_metadata known")),
    Twin("aerokit.vehicle.calibration.calibration.Calibration", "CalibrationTwin"),
    Twin("aerokit.vehicle.calibration.calibration.CalibrationControl"),
    Twin("aerokit.vehicle.missions.mission.MissionControl"),
    Twin("aerokit.vehicle.missions.plans.FenceControl"),
    Twin("aerokit.vehicle.missions.plans.RallyControl"),
    Twin("aerokit.vehicle.rtk.ntrip.NtripClient", "BlockTwin"),
    Twin("aerokit.vehicle.rtk.rtk.Rtk"),
    Twin("aerokit.vehicle.camera.link.CameraBlock", "BlockTwin"),
    Twin("aerokit.vehicle.camera.photos.PhotoInterval", "PhotoIntervalTwin"),
    Twin("aerokit.vehicle.camera.cameras.Camera"),
    Twin("aerokit.vehicle.components.settings.Settings", direct=_names("known")),
    Twin("aerokit.vehicle.components.component.Component", read_on_loop=_names("files parameters settings")),
    Twin(
        "aerokit.vehicle.vehicle.Vehicle",
        "VehicleTwin",
        without=_names("telemetry"),
        direct=_names("distance_to describe_now"),
        parts=_names(
            "actuators calibrate camera cameras components external guided gimbal gimbals files logs parameters mission"
            " fence rally rtk"
        ),
    ),
    Twin(
        "aerokit.onboard.parameters.ComponentParameters",
        special=_names("__getitem__ __iter__ __len__"),
        direct=_names("__getitem__ __iter__ __len__"),
        page="component_twins",
    ),
    Twin("aerokit.onboard.missions.ComponentMissions", page="component_twins"),
    Twin("aerokit.onboard.sources.ComponentSources", page="component_twins"),
    Twin(
        "aerokit.onboard.component.OnboardComponent",
        "ComponentTwin",
        without=_names("command message connection"),
        read_on_loop=_names("missions sources"),
        page="component_twins",
    ),
    Twin("aerokit.fleets.formation.Following", "BlockTwin", direct=_names("error_m"), page="fleet_twins"),
    Twin(
        "aerokit.fleets.fleet.Selection",
        "SelectionTwin",
        without=_names("vehicles"),
        special=_names("__getitem__"),
        direct=_names("__getitem__"),
        page="fleet_twins",
    ),
    Twin("aerokit.fleets.fleet.Fleet", "FleetTwin", inherits="Selection", page="fleet_twins"),
)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(Path(inspect.getfile(importlib.import_module(module))).read_text(encoding="utf-8"))


@cache
def imports_of(module: str) -> dict[str, tuple[str, str]]:
    """Map each name that a module imports to (module, name there).

    After a plain ``import``, the name there is "".
    """
    imports: dict[str, tuple[str, str]] = {}
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.ImportFrom) and node.module:
            imports |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            imports |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
    return imports


def _class_node(cls: type) -> ast.ClassDef:
    return next(
        node for node in tree(cls.__module__).body if isinstance(node, ast.ClassDef) and node.name == cls.__name__
    )


def function_node(module: str, name: str) -> ast.AsyncFunctionDef:
    return next(node for node in tree(module).body if isinstance(node, ast.AsyncFunctionDef) and node.name == name)


@dataclass
class ClassMember:
    """A member of a class, and the modules whose imports its annotations use."""

    name: str
    module: tuple[str, ...]
    node: ast.FunctionDef | ast.AsyncFunctionDef | None
    returns: ast.expr | None
    text: str | None
    is_cell: bool = False  # True if the member is declared as a state, which becomes a StateCell


def members_of(twin: Twin) -> list[ClassMember]:
    """Return the members of a twin, including inherited ones, in the order of their first definition."""
    cls = _class_of(twin)
    classes_of_base_twin = next((_class_of(base).__mro__ for base in TWINS if base.name == twin.inherits), ())
    members: dict[str, ClassMember] = {}
    fill = _type_argument_filler(cls)
    for base in reversed(cls.__mro__):
        if base.__module__.startswith("aerokit.") and base not in classes_of_base_twin:
            members |= {member.name: fill(member) for member in _own_members(base)}
    public_names = {name for name in members if not name.startswith("_")}
    selected = twin.only or (public_names | twin.special)
    return [member for name, member in members.items() if name in selected and name not in twin.without]


def _class_of(twin: Twin) -> type:
    original: type = getattr(importlib.import_module(twin.module), twin.name)
    return original


def _type_argument_filler(cls: type) -> Callable[[ClassMember], ClassMember]:
    """Return a function that replaces type variables in a member by the type arguments of the bases of ``cls``."""
    arguments: dict[str, str] = {}
    for base in getattr(cls, "__orig_bases__", ()):
        names = [parameter.__name__ for parameter in getattr(get_origin(base), "__parameters__", ())]
        # The type arguments of a base are all forward references, or none is. In the latter case, nothing is replaced.
        values = [argument.__forward_arg__ for argument in get_args(base) if isinstance(argument, ForwardRef)]
        arguments |= dict(zip(names, values))  # noqa: B905 - `values` may be empty

    class Fill(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.Name:
            return ast.Name(arguments.get(node.id, node.id))

    def fill(member: ClassMember) -> ClassMember:
        if not arguments or member.node is None:
            return member
        node = Fill().visit(copy.deepcopy(member.node))
        return replace(member, node=node, returns=node.returns, module=(*member.module, cls.__module__))

    return fill


def _own_members(cls: type) -> Iterator[ClassMember]:
    """Yield the class's own methods, its `StateField`s, and the public attributes that ``__init__`` sets."""
    body = _class_node(cls).body
    for index, node in enumerate(body):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            if node.name == "__init__" and isinstance(node, ast.FunctionDef):
                yield from _attributes(node, (cls.__module__,))
            elif not _is_setter(node):
                yield ClassMember(node.name, (cls.__module__,), node, node.returns, ast.get_docstring(node))
        elif isinstance(node, ast.AnnAssign) and _is_state(node.annotation):
            assert isinstance(node.target, ast.Name)
            assert isinstance(node.annotation, ast.Subscript)
            type_ = ast.Subscript(ast.Name("StateCell"), node.annotation.slice)
            text = _text_below(body, index)
            yield ClassMember(node.target.id, (cls.__module__,), node=None, returns=type_, text=text, is_cell=True)


def _attributes(init: ast.FunctionDef, module: tuple[str, ...]) -> Iterator[ClassMember]:
    """Yield the public attributes that ``__init__`` sets, with the docstrings below them."""
    for index, node in enumerate(init.body):
        target: ast.expr | None = node.target if isinstance(node, ast.AnnAssign) else None
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target = node.targets[0]
        if not isinstance(target, ast.Attribute) or target.attr.startswith("_"):
            continue
        # The type is the annotation or, without one, the class that is called to create the value.
        type_: ast.expr | None = None
        if isinstance(node, ast.AnnAssign):
            type_ = node.annotation
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            type_ = node.value.func
        yield ClassMember(target.attr, module, node=None, returns=type_, text=_text_below(init.body, index))


def _text_below(body: Sequence[ast.stmt], index: int) -> str | None:
    below = body[index + 1] if index + 1 < len(body) else None
    if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
        return inspect.cleandoc(str(below.value.value))
    return None


def _is_state(annotation: ast.expr) -> bool:
    return (
        isinstance(annotation, ast.Subscript)
        and isinstance(annotation.value, ast.Name)
        and annotation.value.id == "StateField"
    )


def decorators_of(node: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    return {ast.unparse(decorator) for decorator in node.decorator_list}


def _is_setter(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(decorator.endswith(".setter") for decorator in decorators_of(node))
