"""Files of a device beside the autopilot: what it takes to have ``vehicle.component(100).files`` work on it.

```python
class Recorder(SimulatedComponent):
    def __init__(self) -> None:
        super().__init__(191)
        self.files = FileTree().put("/DCIM/0001.jpg", b"…")

    def listen(self) -> None:
        serve_files(self, self.files)
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.sim.components.component import SimulatedComponent
    from aerokit.sim.file_tree import FileTree
    from aerokit.sim.ftp import FtpServer

__all__ = ["serve_files"]


def serve_files(component: SimulatedComponent, files: FileTree) -> FtpServer:
    """Have a component serve these files by MAVFTP under its own address, as PX4 does; call it in ``listen()``.

    The tree may change at any time: `FileTree.put` makes a file and its folders. Sessions end when the power goes,
    files stay. ``faults.no_ftp`` of the component makes it deaf.
    """
    from aerokit.sim.px4.ftp import Px4Ftp  # what it takes to import is for those who serve files

    server = Px4Ftp(component, files)
    component.vehicle.when_powered_on(server.restart)
    return server
