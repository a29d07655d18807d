"""How a body resists when joints are put on targets and bones get their lengths: of kernels and twins alike.

A free coordinate that stands alone has a resistance of one; lengths are in the skeleton's unit, whose square
all terms share.
"""

STIFFNESS = 10.0  # of bones against change
SMOOTHNESS = 100.0  # of changes in time: a change of one frame spreads over about ten to each side
STEADINESS = 100.0  # of changes from a frame to the next, while bones get their lengths
STANDING = 1e4  # of feet that stand
FOOT_RESISTANCE = 1e3  # of feet, else knees would keep their place and feet would slide
BONES = 1e5  # with which bones pull while all frames are moved together
DAMPING = 3e3  # of the first of those steps: far from their lengths, legs nearly straight make it overshoot
LATER_DAMPING = 1e3  # of the others, which bring the frames into balance
SLACK = 1e-9  # so that a chain that cannot reach gives the nearest pose instead of none
LONGEST = 0.05  # metres of a coordinate in one step of a single frame
