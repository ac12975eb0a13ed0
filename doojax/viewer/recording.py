"""Recordings of a film for viser's player: a .viser file, or an .html page that needs nothing else."""

from pathlib import Path

from doojax.viewer.films import Film
from doojax.viewer.page import Page, start_server

SECONDS_A_STATE = 0.25


def record(film: Film, path: Path) -> None:
    """Write a recording; its ending, .viser or .html, says which."""
    server = start_server("127.0.0.1", 0)
    try:
        page = Page(server)
        page.stage(film.corners, film.floor, film.planar)
        film.set_up(page.drawing)
        film.show(page.drawing, 0.0)
        recording = server.get_scene_serializer()
        for state in range(1, film.states):
            recording.insert_sleep(SECONDS_A_STATE)
            film.show(page.drawing, float(state))
        recording.insert_sleep(4 * SECONDS_A_STATE)
        if path.suffix == ".html":
            path.write_text(recording.as_html(), encoding="utf-8")
        else:
            path.write_bytes(recording.serialize())
    finally:
        server.stop()
