# pymavlink's mavutil for type checkers, which cannot know that `mavutil.mavlink` is a dialect at run time.
from typing import Any

from pymavlink.dialects.v10 import ardupilotmega as ardupilotmega
from pymavlink.mavutil import *  # noqa: F403

mavlink = ardupilotmega

def __getattr__(name: str) -> Any: ...
