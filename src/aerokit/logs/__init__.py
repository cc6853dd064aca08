"""Flight logs: reading flights, converting them to other formats, and reports."""
