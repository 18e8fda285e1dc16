"""Read the JSON object that a page sends."""

import json
from collections.abc import Mapping
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request


async def json_body(request: Request, most_bytes: int) -> Mapping[str, Any]:
    """Return the JSON object of a request of at most `most_bytes`, else raise HTTPException.

    Its status is 415 for another content type, 413 for a longer body, 400 for other content.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise HTTPException(415)
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > most_bytes:
            raise HTTPException(413)
    try:
        asked = json.loads(data)
    except (ValueError, RecursionError):
        raise HTTPException(400) from None
    if not isinstance(asked, dict):
        raise HTTPException(400)
    return asked
