"""The terminal monitor. Needs the extra ``monitor`` (Textual)."""
