"""MAVLink over a zenoh network: both sides, their keys, and the control lease. Needs the extra ``zenoh``."""
