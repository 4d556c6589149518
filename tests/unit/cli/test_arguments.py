import pytest

from rotaline.cli.arguments import lengths, region_of
from rotaline.errors import SessionError
from rotaline.metrology.model import Region


def test_sizes_and_regions_are_read():
    assert lengths("--nominal", ["diameter=38.004", " depth = 12"]) == {"diameter": 38.004, "depth": 12.0}
    assert region_of(["z=1:20", "radius=0:30.5"]) == Region(z=(1.0, 20.0), radius=(0.0, 30.5))
    assert region_of(None) is None


@pytest.mark.parametrize("text", ["diameter", "=3", "diameter=big", "diameter="])
def test_a_wrong_size_is_named(text):
    with pytest.raises(SessionError, match="--nominal"):
        lengths("--nominal", [text])


@pytest.mark.parametrize("text", ["z", "z=1", "q=1:2", "z=2:1", "z=a:b"])
def test_a_wrong_region_is_named(text):
    with pytest.raises(SessionError, match=f"--region {text}"):
        region_of([text])
