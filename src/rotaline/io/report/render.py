"""From values and a template to the text of a page."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup


def render_template(template: str, style_sheets: tuple[str, ...], **values: Any) -> str:
    """The text of a page: the template filled with the values; ``style`` in it is the text of the style sheets."""
    environment = Environment(
        loader=PackageLoader("rotaline.io.report", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    loader = environment.loader
    assert loader is not None
    style = Markup("".join(loader.get_source(environment, name)[0] for name in style_sheets))
    return environment.get_template(template).render(style=style, **values)
