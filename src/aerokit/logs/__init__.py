"""Flight logs: reading, conversion and reports."""
