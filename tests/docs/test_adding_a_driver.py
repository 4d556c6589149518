"""The example of docs/how-to/adding-a-driver.md is a driver that keeps its contract: both of its files are run here."""

import sys
import types
from pathlib import Path

import rotaline.hardware.lasers
from rotaline.hardware.drivers import FoundDevice

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "adding-a-driver.md").read_text(encoding="utf-8")
DRIVER, TEST = (block.split("```")[0] for block in PAGE.split("```python\n")[1:])

led = types.ModuleType("rotaline.hardware.lasers.led")
sys.modules[led.__name__] = led
exec(compile(DRIVER, "adding-a-driver.md, the driver", "exec"), led.__dict__)
rotaline.hardware.lasers.led = led
_written = {"__name__": __name__}
exec(compile(TEST, "adding-a-driver.md, its test", "exec"), _written)

TestLed = _written["TestLed"]
test_an_output_that_is_not_there_is_named = _written["test_an_output_that_is_not_there_is_named"]


def test_it_finds_outputs(tmp_path, monkeypatch):
    (tmp_path / "one").mkdir()
    monkeypatch.setattr(led, "_OUTPUTS", tmp_path)
    assert led.find() == (FoundDevice("laser", "led", "output one", f'driver = "led"\noutput = "{tmp_path / "one"}"'),)
