"""Images of a session: folders are skipped, and a listed image that is not there is a mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.errors import InputError
from rigkit.io.manifests.session import load_session


def test_a_missing_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "01.jpg").mkdir()
    (tmp_path / "02.jpg").write_bytes(b"")
    (tmp_path / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n')
    session = tmp_path / "session.toml"
    for images in ('"0*.jpg"', '["0*.jpg", "gone.jpg"]'):
        session.write_text(f'schema = "rigkit.session/1"\nimages = {images}\nboard = "board.toml"\n')
        if "gone" in images:
            with pytest.raises(InputError, match=r"nothing matches 'gone\.jpg'; correct or remove it"):
                load_session(session)
        else:
            assert load_session(session).images == (tmp_path / "02.jpg",)
