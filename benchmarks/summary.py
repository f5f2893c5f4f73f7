"""Collects what the benchmarks wrote into summary.json and a table, summary.md."""

import json
from pathlib import Path
from typing import Any, Dict, List

import tyro

from benchmarks._measure import Options, write_json
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

BENCHMARKS = (
    "stage1_vanilla_nerf",
    "stage1_dense",
    "stage1_even",
    "hash_grid",
    "nnfm",
    "stage2_step",
    "render",
    "before",
    "before_float32",
    "memory",
)
"""In the order of the table."""


def collect(folder: Path) -> List[Dict[str, Any]]:
    """The rows of all benchmarks in a folder; each says whether it meets its target, and how it came about.

    Raises:
        InputError: there are none.
    """
    rows = []
    for path in (folder / f"{name}{suffix}.json" for name in BENCHMARKS for suffix in ("", "-cuda")):
        if path.is_file():
            content = json.loads(path.read_text(encoding="utf-8"))
            origin = {key: content[key] for key in ("threads", "commit", "dirty", "date")}
            origin["busy"] = content["load_of_others"]["busy"]
            rows += [row | {"met": row["ratio"] >= row["target"]} | origin for row in content["rows"]]
    if not rows:
        raise InputError(f"There are no results in {folder}; run a benchmark first, or name another --output-dir.")
    return rows


def table(rows: List[Dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| what | against | times as fast, or as small | target | met | device | commit | remarks |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        low, high = (_number(bound) for bound in row["spread"])
        bound = "≥ " if row.get("at_least") else ""
        # What a stopped peer would have needed isn't known, so a miss of a lower bound isn't one for certain.
        met = "yes" if row["met"] else "not known" if row.get("at_least") else "**no**"
        cells = [
            row["what"],
            row["against"],
            f"{bound}{_number(row['ratio'])} ({low} – {high})",
            _number(row["target"]),
            met,
            f"{row['device']}, {row['threads']} threads",
            (row["commit"] or "unknown")[:10] + (", changed" if row["dirty"] else ""),
            "; ".join(_remarks(row)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _remarks(row: Dict[str, Any]) -> List[str]:
    remarks = ["**machine was busy**"] if row["busy"] and row.get("timed", True) else []
    if "bytes" in row:
        peer = f" against {row['against_bytes'] / 1e9:.2f}" if "against_bytes" in row else ""
        remarks.append(f"peak {row['bytes'] / 1e9:.2f}{peer} GB")
    if "psnr_to_exact" in row:
        remarks.append(f"{row['psnr_to_exact']:.1f} dB to exact, first picture in {row['baking_seconds']:.1f} s")
    return remarks


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


@exit_on_input_error
def main(options: Options) -> None:
    """Writes both files into the folder of the results, and prints the table."""
    rows = collect(options.results)
    write_json(options.results / "summary.json", rows)
    text = table(rows)
    (options.results / "summary.md").write_text(text, encoding="utf-8")
    print(text, end="")
    missed = [row["name"] for row in rows if not row["met"]]
    print(
        f"\n{len(rows) - len(missed)} of {len(rows)} meet their targets"
        + (f"; not: {', '.join(missed)}" * bool(missed))
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
