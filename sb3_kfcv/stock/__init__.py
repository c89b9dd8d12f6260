from sb3_kfcv.stock.buffers import StockKFCVReplayBuffer, StockPrioritizedReplayBuffer
from sb3_kfcv.stock.callback import ReplayCallback
from sb3_kfcv.stock.students import StockStudent

__all__ = ["ReplayCallback", "StockKFCVReplayBuffer", "StockPrioritizedReplayBuffer", "StockStudent"]
