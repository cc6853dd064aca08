"""The committed modules equal the generator's output for pymavlink's XML."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from aerokit.errors import InvalidArgument
from aerokit.mavlink import enums, generator, messages, rendering
from aerokit.mavlink.definitions import DialectDefinition, merged_enums, read_xml
from aerokit.mavlink.generator import read_additions, with_added_enums, with_added_messages

PACKAGES = {"messages": messages, "enums": enums}


@pytest.mark.exhaustive
def test_generated_modules_are_up_to_date() -> None:
    if generator.fingerprint() != generator.generated_fingerprint():
        pytest.skip("the XML of the installed pymavlink differs from that of the committed modules")
    assert generator.differences() == []


@pytest.mark.exhaustive
def test_fingerprint_depends_on_xml(tmp_path: Path) -> None:
    for stem in ("minimal", "standard", "common", "development", *generator.MODULES["ardupilotmega"]):
        (tmp_path / f"{stem}.xml").write_bytes((generator.xml_folder() / f"{stem}.xml").read_bytes())
    assert generator.fingerprint(tmp_path) == generator.fingerprint()
    (tmp_path / "minimal.xml").write_bytes((tmp_path / "minimal.xml").read_bytes().replace(b"\n", b"\r\n"))
    assert generator.fingerprint(tmp_path) == generator.fingerprint(), "line endings do not matter"
    text = (tmp_path / "minimal.xml").read_text(encoding="utf-8").replace("system_status", "system_state")
    (tmp_path / "minimal.xml").write_text(text, encoding="utf-8")
    assert generator.fingerprint(tmp_path) != generator.fingerprint()
    assert set(generator.differences(tmp_path)) >= {"messages/__init__.py", "messages/minimal.py"}


def test_generator_rejects_duplicate_names(tmp_path: Path) -> None:
    """A module can hold only one of the two."""
    for stem in ("minimal", "standard", "common", "development", *generator.MODULES["ardupilotmega"]):
        (tmp_path / f"{stem}.xml").write_bytes((generator.xml_folder() / f"{stem}.xml").read_bytes())
    path = tmp_path / "development.xml"
    text, count = re.subn('(<message id="[0-9]+" name=")[A-Z_]+"', r'\1AHRS"', path.read_text(), count=1)
    assert count == 1
    path.write_text(text)
    with pytest.raises(InvalidArgument, match="two definitions would both have the name Ahrs"):
        generator.generate(tmp_path)


def test_generator_writes_without_check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "messages").mkdir()
    (tmp_path / "messages" / "one.py").write_text("before")
    files = {"messages/one.py": "a\n\xe4\n", "enums/two.py": "b\n"}
    monkeypatch.setattr(generator, "generate", lambda folder=None: files)
    monkeypatch.setattr(generator, "FOLDER", tmp_path)
    assert generator.main([]) == 0
    assert {path: (tmp_path / path).read_bytes().decode() for path in files} == files


@pytest.mark.parametrize("text", ['the "best"', '"', 'x"'])
def test_docstring_ending_with_quotation_mark_is_valid(text: str) -> None:
    (line,) = rendering._docstring([text], "")
    assert ast.literal_eval(line) == f"{text} "


@pytest.mark.parametrize("other", [False, True])
def test_generator_check(other: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    if other:
        monkeypatch.setattr(generator, "fingerprint", lambda folder=None: "other")
        assert generator.main(["--check"]) == 0
        assert capsys.readouterr().out.startswith("skipped: the XML of the installed pymavlink differs")
    elif generator.fingerprint() == generator.generated_fingerprint():
        monkeypatch.setattr(generator, "generate", lambda folder=None: {"messages/minimal.py": "changed"})
        assert generator.main(["--check"]) == 1
        assert "differs: messages/minimal.py\n" in capsys.readouterr().out


@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("module", generator.MODULES)
def test_generated_modules_have_all(package: str, module: str) -> None:
    loaded = importlib.import_module(f"aerokit.mavlink.{package}.{module}")
    names = loaded.__all__
    assert len(names) == len(set(names))
    assert all(getattr(PACKAGES[package], name) is getattr(loaded, name) for name in names)


def test_mavlink_import_loads_no_messages() -> None:
    """Nine hundred kilobytes of source are imported only when one of their messages is needed."""
    code = (
        "import sys, aerokit.mavlink\n"
        "print(*sorted(name for name in sys.modules if name.startswith(('aerokit.mavlink.messages.',"
        " 'aerokit.mavlink.enums.', 'aerokit.mavlink.generator', 'xml', 'pymavlink', 'asyncio'))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_additions_do_not_repeat_pymavlink() -> None:
    """An addition that pymavlink has meanwhile must be removed."""
    if generator.fingerprint() != generator.generated_fingerprint():
        pytest.skip("the additions were written for the XML of another pymavlink")
    folder = generator.xml_folder()
    dialects = [read_xml(folder / f"{stem}.xml") for stems in generator.MODULES.values() for stem in stems]
    theirs, their_enums = [m for dialect in dialects for m in dialect.messages], merged_enums(dialects)
    known = {(m.id, f.name): (f.units, f.enum, f.invalid) for m in theirs for f in m.fields}
    for dialect in read_additions():
        for message in dialect.messages:
            alone = DialectDefinition(dialect.name, messages=(message,))
            assert with_added_messages(theirs, [alone]) != theirs, message.name
            for f in message.fields:
                assert known.get((message.id, f.name)) != (f.units, f.enum, f.invalid), f"{message.name}.{f.name}"
        for enum in dialect.enums:
            for entry in enum.entries:
                one = DialectDefinition(dialect.name, enums=(replace(enum, entries=(entry,)),))
                union = {e.name: e.entries for e in with_added_enums(their_enums, [one])}
                assert union != {e.name: e.entries for e in their_enums}, entry.name
