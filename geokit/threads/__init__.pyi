# Run one kernel on all threads of a CPU.
from ._team import Team as Team
from ._team_kernels import Share as Share, item as item, barrier as barrier
