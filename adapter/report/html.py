"""From a template and what it shows to a file with the page."""

from __future__ import annotations

from base64 import b64encode
from hashlib import sha256
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from adapter.model.model_file import whole_file
from adapter.runs.run_folder import RunFolderError

SCRIPT = "page_script.html"  # the one script that a page may run: hover and zoom


def fill(template: str, context: dict[str, Any], package: str = "adapter.report") -> str:
    """The page as HTML text; everything that is not markup already is escaped.

    Args:
        template: file name in a folder `templates` of `package`, or of this one.
        context: what it shows.
        package: for pages of other rooms; they may include the macros and the style from here.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(p, "templates") for p in (package, __package__)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = environment.get_template(SCRIPT).render()
    digest = b64encode(sha256(script.encode()).digest()).decode()
    given = {"script": Markup(script), "script_digest": digest}
    return environment.get_template(template).render({**given, **context})


def write_whole(path: str | Path, page: str) -> Path:
    """Write the page, whole or not at all. Returns the path.

    Raises:
        RunFolderError: the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            part.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be written: {error.strerror}") from error
    return path
