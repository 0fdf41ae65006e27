# SPDX-License-Identifier: Apache-2.0
"""Names in docstrings as their readers see them: ``CellSet.failed`` is found without the module in front.

A name means the described object that ends with it: of several that of the same module, else that of
`shmmap`.  An attribute that only its class describes leads to the class.  What is found nowhere is a warning,
and so an error of the build.
"""

from __future__ import annotations

import importlib
import re
from typing import Any

from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform


def setup(app: Sphinx) -> dict[str, Any]:
    """Write names in full before Sphinx looks for them."""
    app.add_post_transform(_FullNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class _FullNames(SphinxPostTransform):
    default_priority = 5  # Sphinx follows references at 10

    def run(self, **_options: Any) -> None:
        described = self.env.domains["py"].data["objects"]
        for node in self.document.findall(pending_xref):
            if node.get("refdomain") != "py" or node["reftarget"] in described:
                continue
            module, inside = str(node.get("py:module") or ""), str(node.get("py:class") or "")
            full = _described(described, str(node["reftarget"]), module, inside)
            if full is not None:
                node["reftarget"] = full
                node["refspecific"] = False


def _described(described: dict[str, Any], target: str, module: str, inside: str) -> str | None:
    """Return the full name of the described object that a name means."""
    if inside and (full := f"{module}.{inside}.{target}") in described:
        return full
    if (place := _ending_with(described, target, module)) is not None:
        return place
    owner, _, last = target.rpartition(".")
    if owner.islower():  # a module that is not public has an object which is public elsewhere
        return _ending_with(described, last, module)
    owner = owner or inside
    place = _ending_with(described, owner, module) if owner else None
    return place if place is not None and _describes(place, last) else None


def _ending_with(described: dict[str, Any], target: str, module: str) -> str | None:
    """Return the object's name; None where there is none, or several of other modules."""
    found = [name for name in described if name.endswith(f".{target}")]
    places = {(described[name].docname, described[name].node_id) for name in found}
    if len(places) == 1:
        return min(found)
    return next((name for name in (f"{module}.{target}", f"shmmap.{target}") if name in found), None)


def _describes(place: str, attribute: str) -> bool:
    """Whether the docstring of a class names an attribute."""
    module, _, name = place.rpartition(".")
    value = getattr(importlib.import_module(module), name, None)
    return re.search(rf"\b{re.escape(attribute)}\b", value.__doc__ or "") is not None
