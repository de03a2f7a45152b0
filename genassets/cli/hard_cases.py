"""`genassets hard-cases`: the error of the product's functions at the ends of their ranges."""

from __future__ import annotations

from typing import Annotated

import typer


def hard_cases(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Measure every hard case against a closed form or float64 and print error beside tolerance.

    Exit code 1 when a case fails.
    """
    import json

    from genassets.errors import GenAssetsError
    from genassets.hard_cases import case

    outcomes = [case.measure(one) for one in case.hard_cases()]
    failed = [outcome.case for outcome in outcomes if not outcome.ok]
    if as_json:
        document = {"ok": not failed, "cases": [outcome.document() for outcome in outcomes]}
        typer.echo(json.dumps(document, indent=2, allow_nan=False))
    else:
        typer.echo(f"{'case':<40}{'held to':<17}{'unit':<12}{'error':>9}  {'tolerance':>9}  ok")
        for outcome in outcomes:
            typer.echo(
                f"{outcome.case:<40}{outcome.held_to:<17}{outcome.unit:<12}{outcome.error:>9.2g}  "
                f"{outcome.tolerance:>9.2g}  {'yes' if outcome.ok else 'NO'}"
            )
            if outcome.problem:
                typer.echo(f"  {outcome.problem}")
    if failed:
        raise GenAssetsError(
            f"{len(failed)} of {len(outcomes)} hard cases failed: {', '.join(failed)}. A change of the code, of torch "
            "or of the machine's arithmetic lost accuracy there; see docs/hard-cases.md."
        )
