"""The experiments. To add one, write a module with a subclass of `Experiment`, and list it here."""

from snakesim_operator.features.reproduce.experiment import Experiment
from snakesim_operator.features.reproduce.experiments.alben_amplitude import AlbenAmplitude
from snakesim_operator.features.reproduce.experiments.ariizumi_gaits import AriizumiGaits
from snakesim_operator.features.reproduce.experiments.gray_hancock import GrayHancock
from snakesim_operator.features.reproduce.experiments.hirose_serpenoid import HiroseSerpenoid
from snakesim_operator.features.reproduce.experiments.hu_slithering import HuSlithering
from snakesim_operator.features.reproduce.experiments.liljeback_velocity import LiljebackVelocity
from snakesim_operator.features.reproduce.experiments.sanfilippo_hand_over import SanfilippoHandOver

_ALL: tuple[type[Experiment], ...] = (
    SanfilippoHandOver,
    HuSlithering,
    AlbenAmplitude,
    LiljebackVelocity,
    HiroseSerpenoid,
    GrayHancock,
    AriizumiGaits,
)
EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment() for experiment in _ALL}
