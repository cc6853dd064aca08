"""Use a vehicle inside an asyncio web server: GET / returns its state as JSON.

    python examples/web_server.py udpin:0.0.0.0:14550 [port]        then: curl http://127.0.0.1:8080/

The server uses the standard library only. With FastAPI or aiohttp, open the vehicle in their start-up hook.
"""

from __future__ import annotations

import asyncio
import json
import sys

import aerokit


def state_of(vehicle: aerokit.Vehicle) -> dict[str, object]:
    """Return the state as JSON types. Reading values never waits."""
    here = vehicle.position.latest
    return {
        "mode": vehicle.mode_name,
        "armed": vehicle.is_armed,
        "position": None if here is None else here.to_dict(),
        "position_age_s": round(vehicle.position.age, 3) if here is not None else None,
        "link": vehicle.describe_link(),
    }


async def main(address: str, port: int = 8080) -> None:
    """Serve until interrupted."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        body = json.dumps(state_of(vehicle)).encode() + b"\n"
        head = f"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n"
        writer.write(head.encode() + b"Connection: close\r\n\r\n" + body)
        await writer.drain()
        writer.close()

    async with aerokit.connect(address) as vehicle:
        server = await asyncio.start_server(answer, "127.0.0.1", port)
        _, listening_port = server.sockets[0].getsockname()
        print(f"http://127.0.0.1:{listening_port}/", flush=True)
        async with server:
            await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(
        main(
            sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550",
            int(sys.argv[2]) if len(sys.argv) > 2 else 8080,
        )
    )
