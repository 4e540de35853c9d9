"""Training crops drawn in memory; `generator.training.torch_crops`, which needs PyTorch, is imported on demand."""

from generator.training.crops import Batch, Crops
from generator.training.gallery import Gallery, gallery_of, open_gallery, save_gallery

__all__ = ["Batch", "Crops", "Gallery", "gallery_of", "open_gallery", "save_gallery"]
