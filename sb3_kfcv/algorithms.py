"""The algorithms by the names under which the zoo knows them."""

from sb3_kfcv.kfcv_maddpg import KFCVMADDPG
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.per_maddpg import PERMADDPG

ALGOS: dict[str, type[MADDPG]] = {"maddpg": MADDPG, "per_maddpg": PERMADDPG, "kfcv_maddpg": KFCVMADDPG}
