"""Runs DroneKit programs unchanged, as ``python program.py`` does with DroneKit."""

from __future__ import annotations

import argparse
import builtins
import contextlib
import importlib
import importlib.machinery
import importlib.util
import io
import os
import runpy
import sys
import types
import zipfile
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING, NoReturn

from aerokit._internal.formatting import did_you_mean
from aerokit.dronekit.util import errprinter
from aerokit.errors import AerokitError, InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from importlib.abc import Loader, MetaPathFinder
    from types import ModuleType, TracebackType

    from aerokit.dronekit.sitl import ServedVehicle
else:
    Loader = MetaPathFinder = object  # Importing the real classes takes longer than importing the rest of this package.

ALIAS, PACKAGE = "dronekit", "aerokit.dronekit"

SITL_ALIAS, SITL_MODULE = "dronekit_sitl", "aerokit.dronekit.sitl"


def install() -> None:
    """Make ``import dronekit`` and ``from dronekit.lib import …`` import :mod:`aerokit.dronekit`.

    ``import dronekit_sitl`` imports :mod:`aerokit.dronekit.sitl`, unless another ``dronekit_sitl`` was imported before.
    Takes precedence over an installed DroneKit. Idempotent. Call it in the ``conftest.py`` of a test run, or in a
    program that runs DroneKit programs.

    Raises:
        ImportError: another ``dronekit`` was imported before.
    """
    package = importlib.import_module(PACKAGE)
    present = sys.modules.get(ALIAS)
    if present is package:
        return
    if present is not None:
        where = getattr(present, "__file__", None) or "an unknown file"
        raise ImportError(
            f"another dronekit was already imported from {where}: call aerokit.dronekit.install() before the first"
            " import of dronekit",
            name=ALIAS,
        )
    sys.modules[ALIAS] = package
    sys.meta_path.insert(0, _SubmoduleFinder())


def uninstall() -> None:
    """Undo :func:`install`. Modules that were imported under the alias stay usable."""
    if sys.modules.get(ALIAS) is not sys.modules.get(PACKAGE):
        return
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _SubmoduleFinder)]
    for name in list(sys.modules):
        aerokit_name = _aerokit_name(name)
        is_alias = aerokit_name is not None and sys.modules[name] is sys.modules.get(aerokit_name)
        if name == ALIAS or is_alias:
            del sys.modules[name]


def _aerokit_name(name: str) -> str | None:
    """Return the module that an alias such as ``dronekit.lib`` stands for; None if it is no alias."""
    if name == SITL_ALIAS:
        return SITL_MODULE
    return PACKAGE + name.removeprefix(ALIAS) if name.startswith(f"{ALIAS}.") else None


class _SubmoduleFinder(MetaPathFinder):
    """Import finder that makes ``dronekit.mavlink`` the same module object as ``aerokit.dronekit.mavlink``."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        aerokit_name = _aerokit_name(fullname)
        if aerokit_name is None:
            return None
        spec = importlib.util.find_spec(aerokit_name)
        return None if spec is None else ModuleSpec(fullname, _SubmoduleLoader(), origin=spec.origin)


class _SubmoduleLoader(Loader):
    """Loader that returns the aerokit module for an alias. The module keeps its own ``__spec__``."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(_aerokit_name(spec.name) or spec.name)
        self._own_spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._own_spec  # importlib has set it to the spec of the alias before this call.


FAILED, CANNOT_OPEN = 1, 2

OPTIONS_WITH_VALUE = ("--vehicle", "--speedup", "--home")

RUNPY_FILES = (runpy.__file__, "<frozen runpy>")


def run_script(path: str | os.PathLike[str], arguments: Sequence[str] = ()) -> None:
    """Run a DroneKit program in this process, and return when its main program has ended.

    The program runs in the environment of ``python program.py arguments…``: ``sys.argv``, its folder first in
    ``sys.path``, and ``__name__ == '__main__'``. A folder or zip file with a ``__main__.py`` is a program, too. At the
    end, ``sys`` is restored, and open vehicles are closed. ``import dronekit`` continues to import
    :mod:`aerokit.dronekit`.

    Args:
        path: the program.
        arguments: its arguments in ``sys.argv``.

    Raises:
        OSError: the file cannot be read.
        ImportError: another ``dronekit`` was imported before.
        SystemExit: the program called ``sys.exit``. Other exceptions of the program propagate, too.
    """
    from aerokit.dronekit.mavlink import created_connections

    install()
    with _restored_sys(), created_connections() as connections:
        try:
            _run_file(os.fspath(path), arguments)
        finally:
            for connection in tuple(connections):
                connection.close()


def main(arguments: Sequence[str], prog: str = "python -m aerokit.dronekit") -> int:
    """Run, in this process, the program that a command line names. Exceptions of the program propagate.

    Args:
        arguments: ``program.py arguments…`` or ``-m module arguments…``.
        prog: name of this command.

    Returns:
        Exit code: 0; 2 if the program's file cannot be opened; 1 if the program cannot be started for another reason,
        or the simulated vehicle cannot be served.
    """
    own_arguments, program_arguments = _split_at_program(arguments)
    options = parser(prog).parse_args(own_arguments)
    if not options.module and (error := _file_error(options.program)):
        errprinter(f"{prog}: can't open file {options.program!r}: {error}")
        return CANNOT_OPEN
    try:
        install()
        served = _serve(options, prog) if options.sim else None
    except (AerokitError, ImportError) as error:
        errprinter(f"{prog}: {error}")
        return FAILED
    if not getattr(sys.flags, "safe_path", False):
        # The program's folder takes the place of this command's folder.
        sys.path[:1] = [os.getcwd()] if options.module else []
    try:
        error_text = _module_error(options.program) if options.module else _missing_main_error(options.program)
        if error_text:
            errprinter(f"{prog}: {error_text}")
            return FAILED
        sys.excepthook = _print_program_traceback
        run = _run_module if options.module else _run_file
        run(options.program, program_arguments)
    finally:
        if served is not None:
            served.stop()
    return 0


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the parser for the command line up to and including the program."""
    parser = _Parser(
        prog=prog,
        usage=f"{prog} [-h] [--sim [OPTION ...]] (PROGRAM.py | -m MODULE) [ARGUMENT ...]",
        description="Run a DroneKit program unchanged: its 'import dronekit' means aerokit.dronekit.",
    )
    parser.add_argument("-m", dest="module", action="store_true", help="the program is a module, not a file")
    parser.add_argument("program", metavar="PROGRAM", help="a file, or a folder or zip file with a __main__.py")
    sim = parser.add_argument_group("a vehicle for the program")
    sim.add_argument(
        "--sim", action="store_true", help="serve a simulated vehicle on tcp:127.0.0.1:5760 and UDP port 14550"
    )
    sim.add_argument(
        "--vehicle", default="copter", metavar="KIND", help="copter, plane, rover, sub, px4 … (default: copter)"
    )
    sim.add_argument("--speedup", type=float, default=1.0, metavar="X", help="times real time (default: 1)")
    sim.add_argument("--home", metavar="LAT,LON,ALT", help="degrees, metres above sea level (default: Canberra)")
    parser.epilog = "Arguments after PROGRAM are passed to the program."
    return parser


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        prefix = "unrecognized arguments: "
        if message.startswith(prefix) and message != prefix:
            unknown_option = message.removeprefix(prefix).split()[0].partition("=")[0]
            message += did_you_mean(unknown_option, self._option_string_actions)
        super().error(message)


def _split_at_program(arguments: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Return the arguments up to the program, and the program's own arguments."""
    is_option_value = False
    for count, argument in enumerate(arguments, 1):
        if not is_option_value and not argument.startswith("-"):
            return arguments[:count], arguments[count:]
        is_option_value = not is_option_value and argument in OPTIONS_WITH_VALUE
    return arguments, []


def _serve(options: argparse.Namespace, prog: str) -> ServedVehicle:
    from aerokit.dronekit.sitl import parse_home, serve_for_program
    from aerokit.sim.motion import HOME

    if not 0.1 <= options.speedup <= 100:
        raise InvalidArgument(f"speedup = {options.speedup:g} is not allowed: it must be 0.1 to 100")
    home = HOME if options.home is None else parse_home(options.home)
    served = serve_for_program(options.vehicle, home, options.speedup)
    tcp, udp = (address.replace("tcpin:", "tcp:").replace("udpout:", "udp:") for address in served.addresses)
    errprinter(f"{prog}: a simulated {options.vehicle} is on {tcp} and {udp}")
    return served


def _module_error(module: str) -> str | None:
    """Return the error text of ``python -m`` if it cannot run the module; None if it can."""
    try:
        # This imports the module's parent packages, as ``python -m`` does.
        spec = importlib.util.find_spec(module)
        if spec is None:
            return f"No module named {module}"
        folders = spec.submodule_search_locations
        if folders is None or not all(map(_lacks_main, folders)):
            return None
        return f"No module named {module}.__main__; {module!r} is a package and cannot be directly executed"
    except ModuleNotFoundError as error:
        return str(error)


def _missing_main_error(path: str) -> str | None:
    return f"can't find '__main__' module in {path!r}" if _lacks_main(path) else None


def _lacks_main(path: str) -> bool:
    return os.path.isdir(path) and not any(
        os.path.exists(os.path.join(path, name)) for name in ("__main__.py", "__main__.pyc")
    )


def _file_error(path: str) -> str | None:
    try:
        io.open_code(os.path.abspath(path)).close()
    except IsADirectoryError:  # A folder with a __main__.py is a program.
        return None
    except OSError as error:
        return error.strerror
    return None


def _run_module(name: str, arguments: Sequence[str]) -> None:
    sys.argv[:] = ["-m", *arguments]
    runpy.run_module(name, run_name="__main__", alter_sys=True)


def _run_file(path: str, arguments: Sequence[str]) -> None:
    """Run a program as ``python PATH ARGUMENTS`` does."""
    sys.argv[:] = [path, *arguments]
    if os.path.isdir(path) or path.endswith(".pyc") or zipfile.is_zipfile(path):
        runpy.run_path(path, run_name="__main__")
        return
    # For a file, runpy would remove the module `__main__` at the end, but threads may still need the module.
    path = os.path.abspath(path)
    with io.open_code(path) as file:
        source = file.read()
    main = sys.modules["__main__"] = types.ModuleType("__main__")
    main.__file__ = path
    main.__loader__ = importlib.machinery.SourceFileLoader("__main__", path)
    main.__dict__.update(__builtins__=builtins, __cached__=None)
    _prepend_path(os.path.dirname(os.path.realpath(path)))
    exec(compile(source, path, "exec", dont_inherit=True), main.__dict__)


def _prepend_path(folder: str) -> None:
    if not getattr(sys.flags, "safe_path", False):
        sys.path.insert(0, folder)


@contextlib.contextmanager
def _restored_sys() -> Iterator[None]:
    argv = sys.argv[:]
    path = sys.path[:]
    main = sys.modules["__main__"]
    try:
        yield
    finally:
        sys.argv[:] = argv
        sys.path[:] = path
        sys.modules["__main__"] = main


def _print_program_traceback(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    error.__traceback__ = _without_our_frames(traceback)
    sys.__excepthook__(kind, error, error.__traceback__)


def _without_our_frames(traceback: TracebackType | None) -> TracebackType | None:
    entry = traceback
    # Skip the frames of aerokit, up to the function that runs the program. Frames of runpy may follow.
    while entry is not None and entry.tb_frame.f_code not in (_run_file.__code__, _run_module.__code__):
        entry = entry.tb_next
    if entry is None:  # The error did not happen in the program, so all frames are of interest.
        return traceback
    entry = entry.tb_next
    while entry is not None and entry.tb_frame.f_code.co_filename in RUNPY_FILES:
        entry = entry.tb_next
    return entry
