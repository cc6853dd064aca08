"""``aerokit monitor``: the vehicles on a link, in a terminal. Needs the extra ``monitor`` (Textual)."""
