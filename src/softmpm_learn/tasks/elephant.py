"""An elephant in 2D that learns to walk to the right. Outline, sizes and materials are our own choice.

It is about as soft as a firm gel: under its own weight its legs shorten by a tenth. Each leg is split into a front and a
back half and across its knee, so that four muscles bend it; two more pairs curl the trunk.
"""

from dataclasses import dataclass

import numpy as np

from softmpm import Body, Muscle, NeoHookean, Scene
from softmpm_learn.objective import Progress
from softmpm_learn.tasks.outline import Limb, fill, smooth, smooth_line
from softmpm_learn.tasks.task import Resolution, Task, TaskConf, finish, ground

LENGTH = 0.44  # tail to trunk [m]
TORSO = (
    *((0.050, 0.320), (0.030, 0.420), (0.048, 0.515), (0.110, 0.590), (0.210, 0.630), (0.330, 0.637), (0.440, 0.615)),
    *((0.510, 0.590), (0.560, 0.600), (0.620, 0.640), (0.690, 0.652), (0.755, 0.622), (0.800, 0.555), (0.815, 0.480)),
    *((0.790, 0.410), (0.740, 0.385), (0.690, 0.360), (0.655, 0.310), (0.590, 0.270), (0.480, 0.255), (0.330, 0.245)),
    *((0.200, 0.255), (0.100, 0.270)),
)  # rump, back, neck, head, chin, chest, belly: x, y in body lengths, feet at y = 0
TRUNK = (
    *((0.700, 0.560, 0.10), (0.770, 0.500, 0.135), (0.815, 0.420, 0.120), (0.842, 0.320, 0.096), (0.855, 0.215, 0.080)),
    *((0.885, 0.130, 0.072), (0.955, 0.110, 0.064)),
)  # x, y, width
TAIL = ((0.110, 0.530, 0.040), (0.050, 0.490, 0.048), (0.012, 0.410, 0.044), (0.000, 0.310, 0.042))
LEGS = {  # hip and sole
    "leg1": ((0.135, 0.36), (0.085, 0.0)),
    "leg2": ((0.215, 0.36), (0.262, 0.0)),
    "leg3": ((0.520, 0.36), (0.462, 0.0)),
    "leg4": ((0.595, 0.36), (0.640, 0.0)),
}
LEG_WIDTH = ((1.0, 0.130), (0.5, 0.100), (0.2, 0.095), (0.06, 0.103), (0.0, 0.106))  # height over the sole, width
