"""Pictures of the README, the gallery and the pages: all that can be made are there, and some are made."""

import pytest
from PIL import Image

import pictures


def test_every_picture_that_is_made_is_kept():
    made = pictures.pictures()
    assert {"motor.png", "log.png", "tasks.png", "robots.png"} <= set(made)
    for name in made:
        assert (
            pictures.DOCS / name if "/" in name else pictures.DOCS / "pictures" / name
        ).is_file(), name


def test_names_that_are_not_known_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["pictures.py", "nothing.png"])
    with pytest.raises(SystemExit):
        pictures.main()
    assert "nothing.png" in capsys.readouterr().err


@pytest.mark.matrix
@pytest.mark.parametrize("name", ["motor.png", "tasks.png"])
def test_a_picture_is_made(name, tmp_path):
    out = tmp_path / name
    pictures.pictures()[name](out)
    with Image.open(out) as image, Image.open(pictures.DOCS / "pictures" / name) as kept:
        assert image.size == kept.size
        assert len(image.getcolors(256)) > 20
