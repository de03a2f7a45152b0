"""The templates of pages."""

from __future__ import annotations


def fill_page(template: str, **values: object) -> str:
    """The text of a page from a template of this package; jinja2.UndefinedError where a value is missing."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("genassets.reporting", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
