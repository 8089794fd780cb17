"""The light that Hypothesis 2 leaves out: what a reflective card or a room sends back to the wall.

One bounce is all there is only if nothing but the wall reflects. Here the next bounces are computed from the known
geometry, the albedos of card and room, and a BRDF of the angle sum, so that the bias of a one-bounce solution can be
predicted before anybody believes it; the residual of the fit cannot show it.
"""

from wallmirror.interreflection.card import from_card, glow_in_mirror
from wallmirror.interreflection.room import from_room

__all__ = ["from_card", "from_room", "glow_in_mirror"]
