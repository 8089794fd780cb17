"""How often single-channel blind deconvolution succeeds: seeds, methods, and what is known of the supports."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wallmirror.deconvolution import align, blind_richardson_lucy, iterative_blind
from wallmirror.errors import UndeterminedError
from wallmirror.report.style import FAINT, OURS, WARM, clean, new_figure
from wallmirror.thesis.figure import Claim, Outcome, ThesisFigure

Array = NDArray[np.float64]
Support = NDArray[np.bool_]

SUCCESS = 0.1  # largest relative error of signal and of kernel, each after its best shift and scale
_SIGNAL, _KERNEL, _SPIKES = 64, 12, 5
_CASES = 12
_ALPHAS = 10.0 ** np.arange(-5, 2)  # IBD is given the best of these, by the truth
_FILTERS, _STEPS = 100, 200

KNOWLEDGE = ("length of the data", "twice the kernel's extent", "both extents", "every place of a spike")


@dataclass(frozen=True)
class Case:
    """A random pair and the supports that a method is told, both of the data's length N + K - 1."""

    signal: Array
    kernel: Array

    @property
    def data(self) -> Array:
        """The full convolution."""
        return np.convolve(self.signal, self.kernel)

    def supports(self, knowledge: str) -> tuple[Support, Support]:
        """Where signal and kernel may differ from zero; the two extents always sum to N + K."""
        n, k = self.signal.size, self.kernel.size
        extent = {KNOWLEDGE[0]: (n + k) // 2, KNOWLEDGE[1]: 2 * k, KNOWLEDGE[2]: k, KNOWLEDGE[3]: k}[knowledge]
        kernel, signal = np.ones(extent, dtype=np.bool_), np.ones(n + k - extent, dtype=np.bool_)
        if knowledge == KNOWLEDGE[3]:
            signal = self.signal > 0
        return signal, kernel


def random_case(rng: np.random.Generator) -> Case:
    """Five spikes of 64 samples, and a kernel of two lobes on 12 samples: a small wall with a card of five points."""
    signal = np.zeros(_SIGNAL)
    signal[rng.choice(_SIGNAL, _SPIKES, replace=False)] = rng.uniform(0.3, 1, _SPIKES)
    at = np.arange(_KERNEL)
    centres, widths, heights = rng.uniform(1, _KERNEL - 2, 2), rng.uniform(0.8, 1.5, 2), rng.uniform(0.3, 1, 2)
    lobes = heights * np.exp(-0.5 * ((at[:, None] - centres) / widths) ** 2)
    kernel = lobes.sum(axis=1)
    return Case(signal, kernel / kernel.sum())


def by_filters(case: Case, knowledge: str) -> tuple[float, float, float]:
    """The larger of both errors, the signal's alone and the residual of IBD, at the alpha that suits the truth best."""
    data, (signal, kernel) = case.data, case.supports(knowledge)
    outcomes = []
    for alpha in _ALPHAS:
        try:
            found = iterative_blind(
                data,
                signal_support=np.pad(signal, (0, data.size - signal.size)),
                kernel_support=np.pad(kernel, (0, data.size - kernel.size)),
                alpha=float(alpha),
                iterations=_FILTERS,
            )
        except UndeterminedError:  # it vanished: as bad as nothing
            outcomes.append((1.0, 1.0, 1.0))
            continue
        errors = align(found.signal, case.signal).error, align(found.kernel, case.kernel).error
        outcomes.append((max(errors), errors[0], float(found.residual[-1])))
    return min(outcomes)


def by_richardson_lucy(case: Case, knowledge: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """The same of IRL, started from constants but for 1 % at random: what is even at the start stays even."""
    signal, kernel = case.supports(knowledge)
    found = blind_richardson_lucy(
        case.data,
        signal_start=signal.astype(np.float64),
        kernel_start=kernel * (1 + 0.01 * rng.random(kernel.size)),
        iterations=_STEPS,
    )
    errors = align(found.signal, case.signal).error, align(found.kernel, case.kernel).error
    return max(errors), errors[0], float(found.residual[-1])


def interval(rate: float, cases: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate; also where none or all of the cases succeeded."""
    z2 = 1.96**2
    middle = (rate + z2 / (2 * cases)) / (1 + z2 / cases)
    half = math.sqrt(z2 * (rate * (1 - rate) / cases + z2 / (4 * cases**2))) / (1 + z2 / cases)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def judge(successes: float, cases: int) -> Outcome:
    """Whether the methods fail more often than not, as far as so many cases tell."""
    low, high = interval(successes, cases)
    if high < 0.5:
        return "confirmed"
    return "refuted" if low > 0.5 else "undecided"


def success(seed: int) -> ThesisFigure:
    """Success rate over seeds, supports and methods."""
    rng = np.random.default_rng(seed)
    cases = [random_case(rng) for _ in range(_CASES)]
    outcomes = {
        ("IBD", knowledge): np.array([by_filters(case, knowledge) for case in cases]) for knowledge in KNOWLEDGE
    } | {
        ("IRL", knowledge): np.array([by_richardson_lucy(case, knowledge, rng) for case in cases])
        for knowledge in KNOWLEDGE
    }
    rates = {key: float(np.mean(values[:, 0] < SUCCESS)) for key, values in outcomes.items()}
    unrestored = float(np.median([align(case.data, case.signal).error for case in cases]))
    # A good fit of the data with a wrong answer: what a user without the truth would take for success.
    fits = np.concatenate([values for (method, _), values in outcomes.items() if method == "IRL"])
    deceived = float(np.mean((fits[:, 2] < 0.05) & (fits[:, 0] >= SUCCESS)))

    figure = new_figure(10.5, 4.2)
    rate_axes, error_axes = figure.subplots(1, 2)
    place = np.arange(len(KNOWLEDGE))
    for side, (method, colour) in enumerate((("IBD", OURS), ("IRL", WARM))):
        shift = 0.36 * (side - 0.5)
        rate = np.array([rates[method, k] for k in KNOWLEDGE])
        low, high = np.array([interval(r, _CASES) for r in rate]).T
        rate_axes.bar(place + shift, 100 * rate, 0.32, color=colour, label=method)
        ends = 100 * np.array([rate - low, high - rate])
        rate_axes.errorbar(place + shift, 100 * rate, ends, color=FAINT, fmt="none", capsize=3)
        for at, value in zip(place + shift, rate, strict=True):
            rate_axes.annotate(f"{100 * value:.0f}", (at, 100 * value), (7, 3), textcoords="offset points", fontsize=9)
        for k, knowledge in enumerate(KNOWLEDGE):
            errors = np.sort(outcomes[method, knowledge][:, 0])
            spread = np.linspace(-0.12, 0.12, errors.size)
            error_axes.plot(k + shift + spread, errors, ".", color=colour, markersize=5)
    error_axes.axhline(SUCCESS, color=FAINT, linewidth=1, linestyle=":")
    error_axes.annotate("success below", (0, SUCCESS), (-28, 4), textcoords="offset points", fontsize=9, color=FAINT)
    error_axes.set_ylim(0, 1.02)
    error_axes.set_ylabel("larger relative error of the pair")
    rate_axes.set_ylim(0, 108)
    rate_axes.set_ylabel(f"success (% of {_CASES} cases)")
    rate_axes.legend(frameon=False, fontsize=9, loc="upper left")
    for axes in (rate_axes, error_axes):
        axes.set_xticks(place, [k.replace(" the ", "\nthe ").replace(" place", "\nplace") for k in KNOWLEDGE])
        axes.set_xlabel("known of the supports")
        clean(axes)
    exact = max(rates[m, KNOWLEDGE[2]] for m in ("IBD", "IRL"))
    blind = max(rates[m, k] for m in ("IBD", "IRL") for k in KNOWLEDGE[:3])
    return ThesisFigure(
        id="3.2-blind-success",
        title="How often single-channel blind deconvolution succeeds",
        about=f"{_CASES} random pairs without noise (five spikes on 64 samples, a kernel of two lobes on 12), full "
        "convolution. Success: signal and kernel both within 10 % after their best shift and scale. IBD: 100 iterations, "
        f"the best of {_ALPHAS.size} alpha by the truth, so an upper bound; IRL: 200 iterations from constants.",
        figure=figure,
        columns={
            f"{method}, {knowledge}: larger error": np.sort(values[:, 0])
            for (method, knowledge), values in outcomes.items()
        },
        numbers={f"{method}, {knowledge}, success rate": rate for (method, knowledge), rate in rates.items()}
        | {
            "signal's error if the data are taken for it, median": unrestored,
            "IRL: fits to 5 % and is wrong, share": deceived,
        },
        claims=(
            Claim(
                thesis="Single-channel blind methods do not give satisfying results for the inverse problem.",
                outcome=judge(blind, _CASES),
                measured=f"Knowing no more than extents, at most {100 * blind:.0f} % of {_CASES} cases succeed (95 % "
                f"interval up to {100 * interval(blind, _CASES)[1]:.0f} %). Knowing the "
                f"place of every spike, IBD reaches {100 * rates['IBD', KNOWLEDGE[3]]:.0f} % and IRL "
                f"{100 * rates['IRL', KNOWLEDGE[3]]:.0f} %.",
            ),
            Claim(
                thesis="Non-negativity and known, finite supports are the assumptions that the methods need.",
                outcome="corrected" if judge(exact, _CASES) == "confirmed" else "undecided",
                measured=f"They are not enough: with both extents exact and all values >= 0, IBD succeeds in "
                f"{100 * rates['IBD', KNOWLEDGE[2]]:.0f} % and IRL in {100 * rates['IRL', KNOWLEDGE[2]]:.0f} % of the cases. "
                f"Nor does a good fit tell: {100 * deceived:.0f} % of IRL's runs fit the data to 5 % and are wrong.",
            ),
        ),
    )


FIGURES: dict[str, Callable[[int], ThesisFigure]] = {"3.2-blind-success": success}
