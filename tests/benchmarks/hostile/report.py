# SPDX-License-Identifier: Apache-2.0
"""What a scene found: figures, and which of the limits they are over."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["LeftOut", "Report"]


class LeftOut(Exception):
    """A scene cannot be played on this machine; the message says why."""


@dataclass
class Report:
    """One scene's, printed as it grows.

    Parameters
    ----------
    row
        Its name, that of a row of the findings.
    sentence
        What must not happen.

    Attributes
    ----------
    over
        Limits that did not hold.
    figures
        What the table at the end shows: probe's and echo's maximum (ms), memory (MiB), newcomers.
    """

    row: str
    sentence: str
    over: list[str] = field(default_factory=list)
    figures: dict[str, str] = field(default_factory=dict)
    left_out: str = ""

    def begin(self) -> None:
        """Print the heading."""
        print(f"\n{self.row}  {self.sentence}", flush=True)

    def tell(self, text: str) -> None:
        """Print a line of figures."""
        print(f"    {text}", flush=True)

    def limit(self, what: str, value: float, most: float, unit: str = "") -> None:
        """Check a figure."""
        unit = unit and f" {unit}"
        held = value <= most
        self.tell(f"{what}: {value:.6g}{unit}, at most {most:.6g}{unit}" + ("" if held else "  <-- OVER"))
        if not held:
            self.over.append(f"{what} {value:.6g}{unit} (limit {most:.6g})")

    def must(self, what: str, held: bool, instead: str = "") -> None:
        """Check something that is so or not; ``instead`` says what was seen."""
        seen = f": {instead}" if instead else ""
        self.tell(f"{what}{' yes' if held else ' NO'}{seen}" + ("" if held else "  <-- OVER"))
        if not held:
            self.over.append(f"{what}: no{f' ({instead})' if instead else ''}")

    def verdict(self) -> str:
        """OK, or what is over the limit."""
        if self.left_out:
            return f"left out: {self.left_out}"
        return "OVER: " + "; ".join(self.over) if self.over else "OK"

    def end(self) -> None:
        """Print the verdict."""
        self.tell(f"=> {self.verdict()}")
