"""Addresses that lead to one thing, one state and one camera: what follows the ? in the browser's bar.

A page knows its own address and viser does not tell it: a picture that does not exist asks the browser for
it, and leaves it where the server can read it (viser's local storage).
"""

import time
import uuid
from collections.abc import Mapping, Sequence
from urllib.parse import parse_qsl, urlencode

import numpy as np
import viser
from jaxtyping import Float

EYE, TARGET = "eye", "at"  # of the camera, m
PATIENCE = 30.0  # s: a page far away, or on a busy machine, tells late
PREFIX = "viser-user:"  # of the keys that viser lets a server read
ASK = '<img src="data:," style="display: none" onerror="localStorage.setItem(\'{key}\', location.search)">'
SET = '<img src="data:," style="display: none" onerror="history.replaceState(null, \'\', \'{query}\')">'


def asked_for(client: viser.ClientHandle) -> dict[str, str]:
    """What the address says by which somebody has come; nothing if the page does not tell in time."""
    key = f"address-{uuid.uuid4().hex}"
    picture = client.gui.add_html(ASK.format(key=PREFIX + key), order=-1e9)
    client.flush()
    end = time.monotonic() + PATIENCE
    text = None
    try:
        while text is None and time.monotonic() < end:
            text = client.local_storage.get_item(key, timeout=PATIENCE)
            if text is None:
                time.sleep(0.05)
    except (RuntimeError, TimeoutError):  # gone already, or has no storage
        return {}
    picture.remove()
    client.local_storage.remove_item(key)
    return dict(parse_qsl((text or "").lstrip("?")))


def address(place: Mapping[str, object], client: viser.ClientHandle | None = None) -> str:
    """What is to follow an address' host and port; with a client, it leads to where its camera is."""
    everything = {name: str(value) for name, value in place.items()}
    if client is not None:
        everything[EYE] = written(client.camera.position)
        everything[TARGET] = written(client.camera.look_at)
    return "?" + urlencode(everything, safe=",")


def show_address(client: viser.ClientHandle, query: str) -> None:
    """Put an address into somebody's bar."""
    client.gui.add_html(SET.format(query=query.replace("'", "%27")), order=-1e9)
    client.flush()


def written(place: Sequence[float] | Float[np.ndarray, "3"]) -> str:
    """A place as a text, to millimetres."""
    return ",".join(f"{float(value):.3f}" for value in place)


def read_place(text: str) -> Float[np.ndarray, "3"]:
    """A place (m) from a text. Raises ValueError where it is none."""
    try:
        place = np.array([float(value) for value in text.split(",")])
    except ValueError as error:
        raise ValueError(f"{text!r} is no place, expected three numbers (m) with commas") from error
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(f"{text!r} is no place, expected three numbers (m) with commas")
    return place
