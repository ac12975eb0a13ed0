"""Examples moved to where they are as valid and as relevant as where they come from (thesis chapter 3)."""

from doojax.augmentation.examples import Augmented as Augmented
from doojax.augmentation.examples import Bounds as Bounds
from doojax.augmentation.examples import Examples as Examples
from doojax.augmentation.examples import Setting as Setting
from doojax.augmentation.examples import augment as augment
from doojax.augmentation.projection import ProjectionConfig as ProjectionConfig
from doojax.augmentation.projection import project as project
from doojax.augmentation.pushing import PushingSetting as PushingSetting
from doojax.augmentation.ropes import RopeSetting as RopeSetting
from doojax.augmentation.settings import setting_of as setting_of
from doojax.augmentation.settings import usual as usual
