from sb3_kfcv.saving.archive import FileFormatError
from sb3_kfcv.saving.values import register

__all__ = ["FileFormatError", "register"]
