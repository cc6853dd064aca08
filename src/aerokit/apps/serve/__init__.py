"""A web page and an HTTP and WebSocket API for vehicles. ``aerokit serve`` runs it; other programs can mount it.

```python
import aerokit.apps.serve                                   # pip install 'aerokit-mavlink[serve]'

async with aerokit.open_connection("udpin:0.0.0.0:14550") as connection:
    async with aerokit.apps.serve.make_app(connection) as app:     # an ASGI application, with app.token
        ...                                                        # mount it, or run it with uvicorn
```

docs/serve.md describes the API and its security.
"""

from aerokit.apps.serve.app import ServeApp, make_app

__all__ = ["ServeApp", "make_app"]
