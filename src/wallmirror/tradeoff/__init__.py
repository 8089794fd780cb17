"""Work-precision measurements: how much error a second of computing buys, for every way that the library has.

Nothing here draws or prints; `wallmirror.jobs.trading` makes the page. Four panels, one module each: `forward`, `inverse`,
`budget` and `scaling`.
"""
