from sb3_kfcv.matches.arena import Arena, Episodes, Side
from sb3_kfcv.matches.pay_off import PayOffTable, curve, pay_off_table
from sb3_kfcv.matches.ratings import Elo, Equilibrium, elo, equilibrium

__all__ = [
    "Arena",
    "Elo",
    "Episodes",
    "Equilibrium",
    "PayOffTable",
    "Side",
    "curve",
    "elo",
    "equilibrium",
    "pay_off_table",
]
