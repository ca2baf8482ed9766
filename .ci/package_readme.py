"""Build hook of hatchling: the README as a package index shows it, where no file of the repository is beside it.

Links to files become absolute where `[project.urls]` names the repository under "Source"; without, they are the text
alone with the file's name in code marks. Pictures of the repository are left out then.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

try:
    from hatchling.metadata.plugin.interface import MetadataHookInterface
except ImportError:  # tests read `for_index` without the build backend
    MetadataHookInterface = object


class ReadmeHook(MetadataHookInterface):
    """Sets `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Called by hatchling with the table `[project]`."""
        text = (Path(self.root) / "README.md").read_text("utf-8")
        source = metadata.get("urls", {}).get("Source", "")
        base = f"{source.rstrip('/')}/blob/main" if source else ""
        metadata["readme"] = {"content-type": "text/markdown", "text": for_index(text, base)}


def for_index(text: str, base: str) -> str:
    """The README without links that lead nowhere.

    Args:
        text: Markdown.
        base: address of the repository's files; empty where there is none.
    """
    relative = r"(?!https?:|mailto:|#)([^)\s]+)"
    if base:
        pictures = f"{base.replace('/blob/', '/raw/')}/"
        text = re.sub(rf"!\[([^\]]*)\]\({relative}\)", rf"![\1]({pictures}\2)", text)
        return re.sub(rf"(?<!!)\[([^\]]*)\]\({relative}\)", rf"[\1]({base}/\2)", text)
    text = re.sub(rf"!\[[^\]]*\]\({relative}\)\n*", "", text)
    return re.sub(rf"\[([^\]]*)\]\({relative}\)", _named, text)


def _named(link: re.Match[str]) -> str:
    said, file = link[1], link[2]
    return f"`{file}`" if said.strip("`") == file else f"{said} (`{file}`)"
