"""The pymavlink client of ``transfers.py``: ``mavparm``-like list, ``mavftp``, and ``mavwp`` with an item loop.

Code that pymavlink does not provide follows MAVProxy, with shorter delays: missing parameters are requested after half
a second of silence, and an item is requested again after a second. ``mavftp`` uses blocks of 239 bytes instead of 80.
During an upload the vehicle repeats its requests.
"""

from __future__ import annotations

import logging
import os
import time
from typing import Any

os.environ["MAVLINK20"] = "1"

from client import Task, run
from content import DOWNLOAD_PATH, LIMIT_S, UPLOAD_PATH, mission_items
from pymavlink import mavftp, mavutil, mavwp

SILENCE_S = 0.5
RETRY_S = 1.0
ACCEPTED, INVALID_SEQUENCE = 0, 13
SETTINGS = [
    ("debug", int, 0),
    ("pkt_loss_tx", int, 0),
    ("pkt_loss_rx", int, 0),
    ("max_backlog", int, 5),
    ("burst_read_size", int, 239),
    ("write_size", int, 239),
    ("write_qsize", int, 5),
    ("idle_detection_time", float, 3.7),
    ("read_retry_time", float, 1.0),
    ("retry_time", float, 0.5),
]


def perform(task: Task) -> Any:
    """Connect, then transfer. Only the transfer is timed."""
    master: Any = mavutil.mavlink_connection(task.address, source_system=254)
    master.wait_heartbeat(timeout=30)
    if task.way == "mavftp":
        logging.disable(logging.CRITICAL)
    work = {
        "parameters": _parameters_ftp if task.way == "mavftp" else _parameters_list,
        "mission_upload": _mission_upload,
        "mission_download": _mission_download,
        "file_download": _file_download,
        "file_upload": _file_upload,
    }[task.name]
    task.begin()
    return work(master, task)


def _parameters_list(master: Any, task: Task) -> dict[str, float]:
    values: dict[int, tuple[str, float]] = {}
    count = None
    master.param_fetch_all()
    while count is None or len(values) < count:
        message = master.recv_match(type="PARAM_VALUE", blocking=True, timeout=SILENCE_S)
        if message is not None:
            count = message.param_count
            if message.param_index < count:
                values[message.param_index] = (message.param_id, message.param_value)
        elif count is None:
            master.param_fetch_all()
        else:
            for index in set(range(count)) - set(values):
                master.param_fetch_one(index)
    return dict(values.values())


def _parameters_ftp(master: Any, task: Task) -> dict[str, float]:
    path = task.folder / "params.txt"
    ftp = _ftp(master)
    ftp.cmd_getparams([str(path)])
    _check(ftp.process_ftp_reply("getparams", timeout=LIMIT_S))
    rows = (line.replace(",", " ").split() for line in path.read_text().splitlines() if line[:1] != "#")
    return {row[0]: float(row[1]) for row in rows if row}


def _mission_upload(master: Any, task: Task) -> None:
    loader = mavwp.MAVWPLoader(master.target_system, master.target_component)
    for number, item in enumerate([mission_items(1)[0], *mission_items(task.size)]):
        loader.add(_wire_item(master, number, item))
    end, sent = loader.count(), -1
    master.waypoint_count_send(end)
    while True:
        message = master.recv_match(
            type=["MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"], blocking=True, timeout=RETRY_S
        )
        if message is None:  # the vehicle repeats its requests by itself
            if sent < 0:
                master.waypoint_count_send(end)
            elif sent == end - 1:
                master.mav.send(loader.wp(sent))
        elif message.get_type() != "MISSION_ACK":
            sent = max(sent, message.seq)
            master.mav.send(loader.wp(message.seq))
        elif message.type == ACCEPTED or sent == end - 1:  # else: taken already
            return
        elif message.type != INVALID_SEQUENCE:
            raise RuntimeError(f"MISSION_ACK {message.type}")


def _mission_download(master: Any, task: Task) -> list[Any]:
    target = (master.target_system, master.target_component)
    count = _ask(master, "MISSION_COUNT", lambda: master.waypoint_request_list_send(), lambda m: True).count
    items = []
    for number in range(count):
        item = _ask(
            master,
            "MISSION_ITEM_INT",
            lambda number=number: master.mav.mission_request_int_send(*target, number),
            lambda m, number=number: m.seq == number,
        )
        items.append((item.command, item.frame, item.param1, item.param2, item.param3, item.param4,
                      item.x, item.y, item.z))  # fmt: skip
    master.mav.mission_ack_send(*target, 0)
    return items[1:]


def _file_download(master: Any, task: Task) -> None:
    ftp = _ftp(master)
    ftp.cmd_get([DOWNLOAD_PATH, str(task.folder / "out.bin")])
    _check(ftp.process_ftp_reply("OpenFileRO", timeout=LIMIT_S))


def _file_upload(master: Any, task: Task) -> None:
    ftp = _ftp(master)
    ftp.cmd_put([str(task.folder / "in.bin"), UPLOAD_PATH])
    _check(ftp.process_ftp_reply("put", timeout=LIMIT_S))


def _ftp(master: Any) -> Any:
    settings = mavftp.MAVFTPSettings(SETTINGS)
    return mavftp.MAVFTP(master, master.target_system, master.target_component, settings)


def _check(result: Any) -> None:
    if result.error_code != 0:
        raise RuntimeError(f"mavftp: error {result.error_code}")


def _ask(master: Any, answer: str, ask: Any, is_it: Any) -> Any:
    while True:
        ask()
        until = time.monotonic() + RETRY_S
        while (left := until - time.monotonic()) > 0:
            message = master.recv_match(type=answer, blocking=True, timeout=left)
            if message is not None and is_it(message):
                return message


def _wire_item(master: Any, number: int, item: Any) -> Any:
    command, frame, *rest = item
    mavlink: Any = mavutil.mavlink
    return mavlink.MAVLink_mission_item_int_message(
        master.target_system, master.target_component, number, frame, command, 0, 1, *rest
    )


if __name__ == "__main__":
    run(perform)
