"""Factories of estimators: the Warp estimator on a device, or GICP on the CPU; and what they are told of the depth camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from synpick_warp.apps.estimation.methods import GICP, EstimatorFactory
from synpick_warp.apps.estimation.scenes import Scene
from synpick_warp.configs.cell.sensors import DepthSensor
from synpick_warp.stages.pose.batch import ObjectModel


def make_factory(
    method: str, models: Sequence[ObjectModel], device: str, threads: int, *, color: bool = True, depth_noise: float = 0.0
) -> EstimatorFactory:
    """Choose the estimator of a method.

    Args:
        method: One of `methods.METHODS`.
        models: Models by index.
        device: Name of the device, as `system.device.pick_device` takes it.
        threads: Threads of GICP.
        color: Whether colour is used; GICP never does.
        depth_noise: Standard deviation of the depth [m]; GICP estimates covariances itself.

    Raises:
        ConfigError: small_gicp is needed and not installed.
        DeviceError: There is no such device.
    """
    if method == GICP:
        from synpick_warp.apps.estimation.gicp import GicpEstimator

        return lambda instances, height, width: GicpEstimator(models, instances, threads)
    from synpick_warp.stages.pose.estimator import EstimatorModels, PoseEstimator, PoseSettings
    from synpick_warp.system.hardware.device import pick_device

    shared = EstimatorModels(models, PoseSettings(color=color, depth_noise=depth_noise), pick_device(device))
    return lambda instances, height, width: PoseEstimator(shared, instances, height, width)


def sensor_noise(sensor: DepthSensor, scenes: Sequence[Scene]) -> float:
    """Standard deviation of the modelled sensor's depth [m], as a data sheet states it: at the scenes' median distance, seen frontally.

    Axial noise, and the quantization of disparity: steps have 1 / √12 of their size as standard deviation.
    """
    depths = np.concatenate([scene.poses[..., 2, 3][scene.asked] for scene in scenes])
    distance, focal = float(np.median(depths)), float(np.median(np.concatenate([scene.intrinsics[:, 0] for scene in scenes])))
    axial = sensor.noise + sensor.noise_growth * (distance - sensor.noise_distance) ** 2
    step = sensor.disparity_step * distance**2 / (focal * sensor.baseline)
    return float(np.hypot(axial, step / np.sqrt(12.0)))
