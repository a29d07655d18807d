"""Motion data: the npz packs, HumanML3D / KIT-ML folders, and the way from one to the other."""

from controlmm.data.clip import Caption, Clip, FeatureClip
from controlmm.data.folder import MotionFolder, write_folder
from controlmm.data.packs import read_joint_folder, read_packs

__all__ = [
    "Caption",
    "Clip",
    "FeatureClip",
    "MotionFolder",
    "read_joint_folder",
    "read_packs",
    "write_folder",
]
