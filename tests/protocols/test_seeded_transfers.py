"""Each kind of transfer over many random bad links."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import ftp_server
import log_vehicle
import mission_vehicles
import pytest
from parameter_channel import Channel, FakeVehicle, table_of

from aerokit.errors import AerokitError
from aerokit.parameters import Parameter
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import RoundTrip, TransferProgress
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.protocols.ftp_transfer import FtpDownload, FtpUpload
from aerokit.protocols.logs import LOG_BLOCK, LogDownload, LogList
from aerokit.protocols.mission_download import MissionDownload
from aerokit.protocols.mission_upload import MissionUpload
from aerokit.protocols.parameter_list import ParameterList
from aerokit.protocols.parameter_requests import ParameterReads, ParameterWrites

SEEDS = range(16)


@dataclass
class Trouble:
    """A link and a caller drawn by seed. One of four links is good, one is nearly dead."""

    seed: int

    def __post_init__(self) -> None:
        self.dice = dice = random.Random(self.seed)
        self.loss = (0.0, 0.1, 0.3, 0.9)[self.seed % 4]
        self.jitter_s = dice.choice((0.0, 0.04, 0.2))
        self.doubling = dice.choice((0.0, 0.2))
        self.round_trip = RoundTrip(dice.choice((None, 0.1, 0.4)))
        self.idle_timeout_s = dice.choice((2.0, 10.0))
        self.size = dice.choice((0, 1, 239, 240, 3000, 7001))
        self.is_bytewise = dice.random() < 0.5
        self.reported: list[TransferProgress] = []

    @property
    def options(self) -> dict[str, Any]:
        return {
            "round_trip": self.round_trip,
            "idle_timeout_s": self.idle_timeout_s,
            "on_progress": self.reported.append,
        }

    def channel(self, parameters: list[Parameter]) -> Channel:
        vehicle = FakeVehicle(parameters, bytewise=self.is_bytewise)
        vehicle.refuses, vehicle.hash_first = self.dice.random() < 0.5, self.dice.random() < 0.5
        return Channel(vehicle, loss=self.loss, jitter_s=self.jitter_s, seed=self.seed)

    def server(self, content: bytes) -> ftp_server.FileServer:
        burst, queue = self.dice.choice((5, 30, 500)), self.dice.choice((None, 5))
        return ftp_server.FileServer(
            bytearray(content),
            burst,
            queue,
            exact_end=self.dice.random() < 0.5,
            has_burst=self.dice.random() < 0.8,
        )

    def radio(self) -> mission_vehicles.Radio:
        return mission_vehicles.Radio(self.seed, self.loss, self.doubling, jitter_s=self.jitter_s)

    def over_ftp(self, exchange: Any, server: ftp_server.FileServer) -> None:
        air = {"loss": self.loss, "duplicates": self.doubling, "jitter_s": self.jitter_s}
        ftp_server.run(exchange, server, **air, seed=self.seed)


def read_file(trouble: Trouble) -> bool:
    written, data = bytearray(), log_vehicle.content(trouble.size)
    client, path = ftp_server.make_client(65530), trouble.dice.choice(("/a", "@SYS/a"))
    into = Reassembly(written.extend, block_size=DATA_SIZE)
    exchange = FtpDownload(client, path, into, session=1, size=trouble.size, **trouble.options)
    trouble.over_ftp(exchange, trouble.server(data))
    return exchange.result() == trouble.size and written == data


def write_file(trouble: Trouble) -> bool:
    data, server = log_vehicle.content(trouble.size), trouble.server(b"")
    exchange = FtpUpload(ftp_server.make_client(), "/a", data, session=1, **trouble.options)
    trouble.over_ftp(exchange, server)
    exchange.result()
    return server.content == data


def list_logs(trouble: Trouble) -> bool:
    first = trouble.dice.choice((0, 1))
    logs = [log_vehicle.content(size) for size in range(trouble.dice.randint(1, 40))]
    vehicle = log_vehicle.LogVehicle(logs, first, latest_wins=trouble.is_bytewise)
    exchange = LogList(1, 1, first_id=first, **trouble.options)
    log_vehicle.run(exchange, vehicle, loss=trouble.loss, seed=trouble.seed)
    return [log.size for log in exchange.result()] == list(range(len(logs)))


def read_log(trouble: Trouble) -> bool:
    written, data = bytearray(), log_vehicle.content(trouble.size)
    vehicle = log_vehicle.LogVehicle([data], latest_wins=trouble.is_bytewise)
    into = Reassembly(written.extend, block_size=LOG_BLOCK)
    exchange = LogDownload(1, 1, 1, trouble.size, into, **trouble.options)
    log_vehicle.run(exchange, vehicle, loss=trouble.loss, seed=trouble.seed)
    exchange.result()
    return written == data


def list_parameters(trouble: Trouble) -> bool:
    table = table_of(trouble.dice.choice((1, 2, 9, 60, 140)))
    exchange = ParameterList(1, 1, bytewise=trouble.is_bytewise, **trouble.options)
    return list(trouble.channel(table).run(exchange).values()) == table


def read_parameters(trouble: Trouble) -> bool:
    table = table_of(30)
    names = [*(parameter.name for parameter in trouble.dice.sample(table, 12)), "NOT_THERE"]
    exchange = ParameterReads(1, 1, names, bytewise=trouble.is_bytewise, probe=True, own_system=255, **trouble.options)
    answers = trouble.channel(table).run(exchange)
    return all(isinstance(answers[name], Parameter) or trouble.loss > 0.5 for name in names[:-1])


def set_parameters(trouble: Trouble) -> bool:
    table = table_of(30)
    before = {parameter.name: parameter.value for parameter in table}
    wanted = [parameter.replace(value=parameter.value + 1, index=None) for parameter in trouble.dice.sample(table, 12)]
    exchange = ParameterWrites(
        1, 1, wanted, bytewise=trouble.is_bytewise, before=before, recent=[wanted[0].name], **trouble.options
    )
    channel = trouble.channel(table)
    answers = channel.run(exchange)
    confirmed = [parameter for parameter in wanted if isinstance(answers[parameter.name], Parameter)]
    return trouble.loss > 0.5 or [channel.vehicle.parameters[parameter.name].value for parameter in confirmed] == [
        parameter.value for parameter in wanted
    ]


def upload_mission(trouble: Trouble) -> bool:
    new = mission_vehicles.items(trouble.dice.randint(1, 30))
    model = trouble.dice.choice((mission_vehicles.ArduPilotModel, mission_vehicles.Px4Model))
    vehicle = model(mission_vehicles.items(8, seed=7))
    exchange = MissionUpload(1, 1, new, window=trouble.dice.choice((1, 6)), **trouble.options)
    result = mission_vehicles.run(exchange, vehicle, trouble.radio())
    if result.error is not None:
        raise result.error
    return vehicle.stored == new or not exchange.result().is_confirmed


def download_mission(trouble: Trouble) -> bool:
    held = mission_vehicles.items(trouble.dice.randint(0, 30))
    vehicle = mission_vehicles.ArduPilotModel(held)
    exchange = MissionDownload(1, 1, window=trouble.dice.choice((1, 10)), **trouble.options)
    result = mission_vehicles.run(exchange, vehicle, trouble.radio())
    if result.error is not None:
        raise result.error
    return list(exchange.result().items) == held


TRANSFERS: list[Callable[[Trouble], bool]] = [
    read_file,
    write_file,
    list_logs,
    read_log,
    list_parameters,
    read_parameters,
    set_parameters,
    upload_mission,
    download_mission,
]


@pytest.mark.parametrize("transfer", TRANSFERS, ids=lambda transfer: transfer.__name__)
def test_transfer_over_bad_link_arrives_or_explains(transfer: Callable[[Trouble], bool]) -> None:
    faults = [f"seed {seed}: {fault}" for seed in SEEDS if (fault := fault_of(transfer, seed))]
    assert not faults, "\n".join(faults)


def fault_of(transfer: Callable[[Trouble], bool], seed: int) -> str:
    """Return a description of the fault; empty if the transfer is correct."""
    trouble = Trouble(seed)
    try:
        return "" if transfer(trouble) else "what arrived is not what was sent"
    except AerokitError as error:
        is_excused = trouble.loss > 0 or trouble.idle_timeout_s < 3
        return "" if is_excused else f"gave up over a good link: {error}"
