"""The pymavlink client of ``transfers.py``: ``mavparm``-like list, ``mavftp``, and ``mavwp`` with an item loop.

Code that pymavlink does not provide follows MAVProxy, with shorter delays: missing parameters are requested after half
a second of silence, and an item is requested again after a second. ``mavftp`` uses blocks of 239 bytes instead of 80.
During an upload the vehicle repeats its requests.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ["MAVLINK20"] = "1"

from client import Task, run
from content import DOWNLOAD_PATH, LIMIT_S, UPLOAD_PATH, items_with_home
from pymavlink import mavftp, mavutil, mavwp

SILENCE_S = 0.5
RETRY_S = 1.0
# Values of MAV_MISSION_RESULT.
ACCEPTED = 0
INVALID_SEQUENCE = 13
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
    if task.method == "mavftp":
        logging.disable(logging.CRITICAL)
    transfer = {
        "parameters": _parameters_ftp if task.method == "mavftp" else _parameters_list,
        "mission_upload": _mission_upload,
        "mission_download": _mission_download,
        "file_download": _file_download,
        "file_upload": _file_upload,
    }[task.name]
    task.begin()
    return transfer(master, task)


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
    values = {}
    for line in path.read_text().splitlines():
        words = line.replace(",", " ").split()
        if words and not line.startswith("#"):
            name, value, *_ = words
            values[name] = float(value)
    return values


def _mission_upload(master: Any, task: Task) -> None:
    loader = mavwp.MAVWPLoader(master.target_system, master.target_component)
    for seq, item in enumerate(items_with_home(task.size)):
        loader.add(_wire_item(master, seq, item))
    count = loader.count()
    highest_sent = -1  # seq of the last item that was sent
    master.waypoint_count_send(count)
    while True:
        message = master.recv_match(
            type=["MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"], blocking=True, timeout=RETRY_S
        )
        has_sent_all = highest_sent == count - 1
        if message is None:  # during the upload, the vehicle repeats its requests by itself
            if highest_sent < 0:
                master.waypoint_count_send(count)
            elif has_sent_all:
                master.mav.send(loader.wp(highest_sent))
        elif message.get_type() != "MISSION_ACK":
            highest_sent = max(highest_sent, message.seq)
            master.mav.send(loader.wp(message.seq))
        elif message.type == ACCEPTED or has_sent_all:  # a repeated last item may be rejected: the upload is complete
            return
        elif message.type != INVALID_SEQUENCE:
            raise RuntimeError(f"MISSION_ACK {message.type}")


def _mission_download(master: Any, task: Task) -> list[Any]:
    target = (master.target_system, master.target_component)
    count = _request(master, "MISSION_COUNT", master.waypoint_request_list_send).count
    items = []
    for seq in range(count):
        send_request = partial(master.mav.mission_request_int_send, *target, seq)
        item = _request(master, "MISSION_ITEM_INT", send_request, seq=seq)
        items.append((item.command, item.frame, item.param1, item.param2, item.param3, item.param4,
                      item.x, item.y, item.z))  # fmt: skip
    master.mav.mission_ack_send(*target, ACCEPTED)
    _home, *waypoints = items
    return waypoints


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


def _request(master: Any, answer_type: str, send_request: Callable[[], object], seq: int | None = None) -> Any:
    """Send a request until it is answered, and return the answer: with this ``seq``, if one is given."""
    while True:
        send_request()
        retry_at = time.monotonic() + RETRY_S
        while (remaining_s := retry_at - time.monotonic()) > 0:
            message = master.recv_match(type=answer_type, blocking=True, timeout=remaining_s)
            if message is not None and (seq is None or message.seq == seq):
                return message


def _wire_item(master: Any, seq: int, item: Any) -> Any:
    command, frame, p1, p2, p3, p4, x, y, z = item
    mavlink: Any = mavutil.mavlink
    return mavlink.MAVLink_mission_item_int_message(
        target_system=master.target_system, target_component=master.target_component, seq=seq, frame=frame,
        command=command, current=0, autocontinue=1, param1=p1, param2=p2, param3=p3, param4=p4, x=x, y=y, z=z,
    )  # fmt: skip


if __name__ == "__main__":
    run(perform)
