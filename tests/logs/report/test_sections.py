"""Texts of the report's sections against the data that they describe."""

from __future__ import annotations

from pathlib import Path

from aerokit.logs.flights import FlightLog
from aerokit.logs.report.page import Paragraphs, Section, Table
from aerokit.logs.report.sections import SECTIONS
from aerokit.logs.report.statistics import STATISTICS, FlightStatistics, statistics_of, summary


def section_of(flight: FlightLog, title: str) -> Section:
    return next(section for make in SECTIONS if (section := make(flight)) is not None and section.title == title)


def parameter_titles(flight: FlightLog) -> list[str]:
    return [part.title for part in section_of(flight, "Parameters").parts if isinstance(part, Table)]


def test_tables_of_all_parameters_and_changes_say_all() -> None:
    flight = FlightLog(Path("flight.tlog"), ends_at=10.0)
    flight.set_parameter(0.0, "RTL_ALT", 15.0)
    flight.set_parameter(1.0, "RTL_ALT", 30.0)
    assert parameter_titles(flight) == ["all 1 changes", "all 1 parameters"]


def test_tables_that_are_cut_off_name_both_counts() -> None:
    flight = FlightLog(Path("flight.tlog"), ends_at=10.0)
    for number in range(6000):
        flight.set_parameter(0.0, f"P{number}", 0.0)
        flight.set_parameter(1.0, f"P{number}", 1.0)
    assert parameter_titles(flight) == ["first 2000 of 6000 changes", "first 5000 of 6000 parameters"]


def test_changes_by_autopilot_do_not_contradict_the_sentence_before() -> None:
    flight = FlightLog(Path("flight.tlog"), ends_at=10.0)
    flight.set_parameter(0.0, "STAT_RUNTIME", 1.0)
    flight.set_parameter(1.0, "STAT_RUNTIME", 2.0)
    paragraphs = [part for part in section_of(flight, "Parameters").parts if isinstance(part, Paragraphs)]
    sentences = [text for part in paragraphs for text in part.lines]
    assert sentences[0] == "The log contains no change of a parameter by the pilot or a program."
    assert sentences[1].startswith("1 changes by the autopilot itself")


def test_comparison_has_all_statistics() -> None:
    assert list(FlightStatistics.__annotations__) == list(STATISTICS), "STATISTICS needs a row for each field"


def test_summary_warns_of_value_out_of_range() -> None:
    flight = FlightLog(Path("flight.tlog"), ends_at=10.0)
    for time_s, level in enumerate([10.0, 45.0, 12.0]):
        flight.vibration.add(float(time_s), level, 1.0, 1.0, 0.0)
    assert "Check: vibration up to 45 m/s² (normal: below 30)." in summary(flight, statistics_of(flight))


def test_link_section_of_bin_does_not_promise_lost_messages() -> None:
    flight = FlightLog(Path("flight.bin"), ends_at=10.0)
    for time_s in range(10):
        flight.radio.add(float(time_s), *[100.0] * len(flight.radio.names))
    section = section_of(flight, "Link")
    assert section.parts
    assert section.explanation.startswith("Reports of the telemetry radio.")
