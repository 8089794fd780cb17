"""The thesis's own blind de-rendering (Algorithm 3): alternating least squares over an unstructured B_diff.

It takes from the geometry which pixels see the same wall point (`chaining`), and nothing else: the BRDF of each
wall point and element is an unknown of its own. It is kept as the thesis has it, for comparison; `solve` also uses
that the BRDF depends on the angle sum, and is exact where this one is not.

Where text and code of the thesis differ, the defaults are the code's, and the text's choice is an argument:
alpha 10 (text: 0.1), tolerance 1e-3 (1e-2), the rule of stopping, and a cap that the text does not have.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wallmirror.captures import CaptureSet
from wallmirror.derendering.alternation import Alternation, Stopping, alternate, group
from wallmirror.derendering.chaining import Chain, Start, chain_views
from wallmirror.errors import InputError, UndeterminedError

Array = NDArray[np.float64]

#: How the columns are put in order: "mended" permutes source and BRDF alike, "original" as the thesis's code does.
Ordering = Literal["mended", "original"]
#: What is kept of B_diff: its largest entries, or the rows in which they stand.
Support = Literal["entries", "rows"]


@dataclass(frozen=True, kw_only=True)
class UnstructuredSolution:
    """What Algorithm 3 returns. It has no error bars and no certificate: the thesis's method offers none.

    Parameters
    ----------
    source:
        V, shape (M, B), in [0, 1].
    brdf:
        B_a, shape (A, N, M), in [0, 1]; the weight in front of the BRDF is part of it (eq. 4.8).
    structured:
        B_diff, shape (rows, M).
    objective:
        Misfit plus alpha |B_diff|_1 after the source's and after the BRDF's half, shape (alternations, 2).
    misfit:
        The same without the L1 term.
    alternations:
        How many were done.
    stopped_by:
        "tolerance" or "cap".
    support:
        Number of entries of B_diff that may differ from zero.
    residual:
        |L - B V| / |L|.
    kkt:
        Largest violation of the optimality conditions over all halves, in units of V and B (`box_qp.optimality`).
    order:
        Column of the alternation that became element i of the BRDF, shape (M,).
    status:
        A sentence that says how it ended and how far to trust it.
    """

    source: Array = field(repr=False)
    brdf: Array = field(repr=False)
    structured: Array = field(repr=False)
    objective: Array = field(repr=False)
    misfit: Array = field(repr=False)
    alternations: int
    stopped_by: Literal["tolerance", "cap"]
    support: int
    residual: float
    kkt: float
    order: tuple[int, ...]
    status: str


def de_render_unstructured(
    captures: CaptureSet,
    *,
    alpha: float = 10.0,
    tolerance: float = 1e-3,
    proportion: float = 0.05,
    cap: int = 30,
    start: Start = "middle",
    support: Support = "entries",
    stopping: Stopping = "code",
    ordering: Ordering = "mended",
    rng: np.random.Generator | int = 0,
) -> UnstructuredSolution:
    """Recover pattern and BRDF by the thesis's alternation (Algorithm 3), with the defaults of its code.

    Parameters
    ----------
    captures:
        Radiance (A, N, B) with observer and card. Weights and variances are not used. Since V and B are confined to
        [0, 1] and alpha is not relative, the unit of the radiance matters: the thesis has lobes of height 1.
    alpha:
        Weight of |B_diff|_1 (eq. 4.16).
    tolerance:
        Decrease at which the alternation ends.
    proportion:
        Share of the entries of B_diff that are estimated: the largest of U(mean render), chosen once.
    cap:
        Largest number of alternations.
    start:
        View at which the chain starts (Algorithm 2): "middle" or "first".
    support:
        "entries": so many entries as `proportion` says, which cuts the last row short; "rows": as many whole rows, the
        same for all columns.
    stopping:
        "code" or "text", see `alternate`. The text's rule, taken at its word, mostly stops after one alternation.
    ordering:
        The columns are sorted by the row of their peak. "original" applies the permutation to the BRDF and its inverse
        to the source, as the thesis's code does; that is the same for 10 of the 24 permutations of four elements.
    rng:
        Generator or seed of the random V at the start. It matters: B starts with equal columns.

    Raises
    ------
    InputError
        For an option out of range, or radiance whose square is.
    UndeterminedError
        If every capture is dark.

    Examples
    --------
    >>> from wallmirror.scene import load_scene
    >>> from wallmirror.transport import radiance, transport_matrix
    >>> scene = load_scene("flat_wall_lobes")
    >>> model = transport_matrix(scene.observer, scene.card, scene.wall.brdf, weights="thesis")
    >>> light = radiance(model, np.random.default_rng(1).random((scene.card.elements, 20)))
    >>> captures = CaptureSet(observer=scene.observer, card=scene.card, transport="thesis", radiance=light / light.max())
    >>> de_render_unstructured(captures, cap=2).alternations
    2
    """
    _check(alpha, tolerance, proportion, cap)
    for name, value, choices in (
        ("support", support, Support),
        ("stopping", stopping, Stopping),
        ("ordering", ordering, Ordering),
    ):
        if value not in get_args(choices):
            raise InputError(f'is "{value}"; choose one of {", ".join(get_args(choices))}', field=name)
    data = captures.radiance
    with np.errstate(over="ignore"):
        power = float(np.sum(data * data))
    if not np.any(data):
        raise UndeterminedError("every capture is dark; light the card and capture again")
    if not sys.float_info.min <= power < math.inf:
        raise InputError(
            "is too small or too large to square; V and B lie in [0, 1], so bring it to order one", field="radiance"
        )
    elements = captures.card.elements
    chain = chain_views(captures.observer, start=start)
    mean = chain.structured(np.mean(data, axis=2, keepdims=True))[:, 0]
    kept = _kept(chain, mean, elements, proportion, support)
    grouped = group(chain, data, kept)
    end = alternate(
        grouped,
        np.where(kept, mean[:, None], 0.0)[grouped.rows],
        np.random.default_rng(rng).random((elements, data.shape[2])),
        alpha=alpha,
        tolerance=tolerance,
        cap=cap,
        stopping=stopping,
    )
    structured = np.zeros((chain.rows, elements))
    structured[grouped.rows] = end.brdf
    matrices = chain.spread(structured)
    order = _order(matrices[chain.views], captures.card.elements_x)
    residual = math.sqrt(end.misfit[-1, 1] / power)
    return UnstructuredSolution(
        source=end.source[order] if ordering == "mended" else end.source[np.argsort(order)],
        brdf=matrices[..., order],
        structured=structured[:, order],
        objective=end.objective,
        misfit=end.misfit,
        alternations=len(end.objective),
        stopped_by=end.stopped_by,
        support=int(np.count_nonzero(kept)),
        residual=residual,
        kkt=end.kkt,
        order=tuple(map(int, order)),
        status=_status(end, residual),
    )


def _kept(chain: Chain, mean: Array, elements: int, proportion: float, support: Support) -> NDArray[np.bool_]:
    """The entries of B_diff that are estimated, shape (rows, M), by U(mean render), which is the same in all columns."""
    size = chain.rows * elements
    count = math.floor(proportion * size + 0.5)
    if support == "rows":
        count -= count % elements
    if count == 0:
        raise InputError(
            f"is {proportion:g} of {size} coefficients and keeps none; give a larger share", field="proportion"
        )
    # Equal entries in the order in which a stable sort, column by column, leaves them: the first columns get what is left
    # of a count that is no multiple of M.
    kept = np.zeros(size, dtype=bool)
    kept[np.argsort(-np.tile(mean, elements), kind="stable")[:count]] = True
    matrix = kept.reshape(elements, -1).T.copy()
    # The row of zeros at the end belongs to no pixel.
    matrix[chain.picked.size :] = False
    return matrix


def _order(matrices: Array, elements_x: tuple[float, ...]) -> NDArray[np.intp]:
    """Column for each element: columns by the mean row of their peaks in the first A/M views, elements by their x."""
    views, _, elements = matrices.shape
    used = max(1, math.floor(views / elements + 0.5))
    peak = np.mean(np.argmax(matrices[:used], axis=1), axis=0)
    order = np.empty(elements, dtype=np.intp)
    order[np.argsort(elements_x, kind="stable")] = np.argsort(peak, kind="stable")
    return order


def _check(alpha: float, tolerance: float, proportion: float, cap: int) -> None:
    if not (math.isfinite(alpha) and alpha >= 0):
        raise InputError(f"is {alpha:g}; give a weight >= 0", field="alpha")
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise InputError(f"is {tolerance:g}; give a decrease >= 0", field="tolerance")
    if not 0 < proportion <= 1:
        raise InputError(f"is {proportion:g}; give a share in (0, 1]", field="proportion")
    if cap < 1:
        raise InputError(f"is {cap}; give at least one alternation", field="cap")


def _status(end: Alternation, residual: float) -> str:
    if not (np.any(end.brdf > 0) and np.any(end.source > 0)):
        return "The L1 term has driven all to zero; lower alpha or scale the radiance up to order one."
    done = f"{len(end.objective)} alternation{'s' if len(end.objective) > 1 else ''}"
    how = (
        f"Reached the tolerance after {done}"
        if end.stopped_by == "tolerance"
        else f"Stopped at the cap of {done} before the tolerance was reached"
    )
    return (
        f"{how}, with {100 * residual:.2g} % of the radiance unexplained; the method gives no error bars and its answer "
        "depends on the random start, so try several seeds, or use solve."
    )
