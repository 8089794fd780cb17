"""Monte Carlo against analytic: a statistical statement with an effect size and the smallest bias it could see.

The renders come as S seeds, each an unbiased, independent estimate of the same picture, whatever sampler made
it; the seeds' scatter is the only estimate of noise used. Three kinds of evidence, none sufficient alone:

- per pixel, a t statistic over seeds, turned into a z score; the largest is judged by Sidak's bound, their
  distribution by Kolmogorov and Smirnov's test (per-tile tests after Jung, Hanika, Dachsbacher, JCGT 9(2), 2020);
- per named bias (gain, lobe shift, lobe loss), the least-squares amplitude of its template in each seed, whose
  mean over seeds sees effects far below one pixel's noise;
- for each such bias the equivalence bound: the smallest amplitude this run would have caught at 99 % power
  (two one-sided tests: Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15, 1987).
"""

from wallmirror.comparison.amplitude import SIGNIFICANCE, cross_weights, detectable_gain
from wallmirror.comparison.comparing import compare
from wallmirror.comparison.verdict import BiasTest, Comparison

__all__ = ["SIGNIFICANCE", "BiasTest", "Comparison", "compare", "cross_weights", "detectable_gain"]
