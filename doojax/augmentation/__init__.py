"""Examples moved to where they are as valid and as relevant as where they come from (thesis chapter 3)."""

from doojax.augmentation.projection import ProjectionConfig as ProjectionConfig
from doojax.augmentation.projection import project as project
from doojax.augmentation.ropes import Bounds as Bounds
from doojax.augmentation.ropes import RopeExamples as RopeExamples
from doojax.augmentation.ropes import Setting as Setting
from doojax.augmentation.ropes import augment as augment
