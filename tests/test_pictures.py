"""Pictures of the README, the gallery and the pages: all are checked in, some are redrawn."""

import pytest
from PIL import Image

import pictures


def test_every_picture_is_checked_in():
    makers = pictures.pictures()
    assert {"motor.png", "log.png", "tasks.png", "robots.png"} <= set(makers)
    for name in makers:
        assert (
            pictures.DOCS / name if "/" in name else pictures.DOCS / "pictures" / name
        ).is_file(), name


def test_unknown_names_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["pictures.py", "nothing.png"])
    with pytest.raises(SystemExit):
        pictures.main()
    assert "nothing.png" in capsys.readouterr().err


@pytest.mark.matrix
@pytest.mark.parametrize("name", ["motor.png", "tasks.png"])
def test_a_picture_can_be_drawn_again(name, tmp_path):
    out = tmp_path / name
    pictures.pictures()[name](out)
    with Image.open(out) as image, Image.open(pictures.DOCS / "pictures" / name) as reference:
        assert image.size == reference.size
        assert len(image.getcolors(256)) > 20
