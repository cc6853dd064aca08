TRANSFERS: dict = {}
