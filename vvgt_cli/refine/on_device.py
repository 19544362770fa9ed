"""Descent on a CUDA device: gsplat draws and differentiates, torch steps as `OwnAxes` does.

What is computed from the start (the numbers that Gaussians share, the axes' order) is made on the CPU, and so are looks
at the check views, so that figures mean the same on both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.errors import DeviceFailed
from vvgt_cli.refine.shared import sample_of
from vvgt_cli.refine.ssim import KERNEL
from vvgt_cli.refine.states import MEDIAN, MEMORY, OUTLIER, OwnAxes
from vvgt_cli.refine.steps import COUNT, EPSILON, FEATURES, RUN
from vvgt_cli.refine.texture import SMOOTH
from vvgt_cli.splat.by_gsplat import capped, draws, picture

if TYPE_CHECKING:
    from torch import Tensor

    from vvgt_cli.cameras import Camera
    from vvgt_cli.gaussians import Gaussians
    from vvgt_cli.refine.options import OptimizeOptions

A_GAUSSIAN, A_PIXEL = 2400, 400  # bytes: with moments, features, slopes and lists of pairs; with the blurs of the loss
ENTRIES = [0, 3, 4, 3, 1, 5, 4, 5, 2]  # of E, row by row, among xx, yy, zz, xy, xz, yz
SYMMETRIC = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # of a matrix, row by row, among xx, xy, xz, yy, yz, zz
SHARED = [*range(6), 9, 10, 11, 12]  # of the fields, those that `steps.KNOWN` counts


def unfit(gaussians: Gaussians, options: OptimizeOptions) -> str | None:
    """Return why descent from Gaussians by such options is the CPU's; None where a device does it."""
    if options.method != "frame":
        return f"the method {options.method}"
    if gaussians.harmonics is not None:
        return "colours that depend on the view"
    if options.ssim > 0:
        return "SSIM in the loss"
    return None if draws(options.rule) else f"the rule {options.rule.name}, by which gsplat does not draw"


class OwnAxesOnDevice(OwnAxes):
    """`OwnAxes` whose arrays lie on a device, and on the CPU when they are asked for there.

    Attributes:
        tensors: means, factors M, opacity logits, colours.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions, free: np.ndarray | None = None,
        device: str = "cuda", draw: Callable[..., tuple[Tensor, Tensor]] = picture,
    ) -> None:  # fmt: skip
        """Put the start on ``device``; ``free`` as of `OwnAxes`, ``draw`` as `picture`.

        Raises:
            DeviceFailed: less memory is free there than is needed.
        """
        import torch

        self.device, self.draw, self.targets = device, draw, dict[int, Any]()
        self._host: tuple[np.ndarray, ...] | None = None
        super().__init__(gaussians, cameras, options.rule, free)
        self.cameras = list(cameras)  # by whose identity targets are known
        if device == "cuda":
            from gsplat.cuda._backend import _C

            if _C is None:
                raise DeviceFailed("gsplat has no kernels: it builds them with CUDA's compiler, which is not there")
            pixels = max(camera.width * camera.height for camera in cameras)
            views = sum(16 * camera.width * camera.height for camera in cameras)
            needed, available = A_GAUSSIAN * len(gaussians) + A_PIXEL * pixels + views, torch.cuda.mem_get_info()[0]
            if needed > available:
                raise DeviceFailed(f"steps need {needed / 1e9:.1f} GB, of which {available / 1e9:.1f} are free")
        self._send()

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The tensors as arrays; what is assigned goes to the device."""
        if self._host is None:
            self._host = tuple(tensor.cpu().numpy() for tensor in self.tensors)
        return self._host

    @arrays.setter
    def arrays(self, values: tuple[np.ndarray, ...]) -> None:
        import torch

        self._host = values
        self.tensors = [torch.from_numpy(np.array(array)).to(self.device) for array in values]

    def _send(self) -> None:
        """Put what is kept beside the arrays on the device."""
        import torch

        self.arrays = self.arrays  # axes have been put in order in place
        self.moments = [torch.from_numpy(np.array(a)).to(self.device) for a in (self.first, self.second)]
        self.there_sent = [torch.from_numpy(array).to(self.device) for array in self.there]
        self.fixed_sent = torch.from_numpy(self.fixed).to(self.device)
        if self.shared is not None:
            known = self.shared.features.transpose(1, 0, 2).reshape(FEATURES, -1)[:, : len(self.arrays[0])]
            self.features = torch.from_numpy(known.astype(np.float32)).to(self.device)
            self.solver = torch.from_numpy(self.shared.solver).to(self.device)

    def saved(self) -> dict[str, np.ndarray]:
        """Return all that the next steps depend on."""
        self.first, self.second = (tensor.cpu().numpy() for tensor in self.moments)
        return super().saved()

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        super().restore(saved)
        self._send()

    def step_on(
        self, camera: Camera, target: np.ndarray, options: OptimizeOptions, error: float | None, share: float,
        speed: float,
    ) -> float:  # fmt: skip
        """Take a step; arguments and what comes back as of `vvgt_cli.refine.loop.step`.

        Raises:
            DeviceFailed: the device is lost, or full.
        """
        import torch

        try:
            if id(camera) not in self.targets:
                self.targets[id(camera)] = torch.from_numpy(np.array(target)).to(self.device)
            rows, now = self.slopes(camera, self.targets[id(camera)], options)
            error = now if error is None else MEMORY * error + (1 - MEMORY) * now
            self.move(rows, error, share, speed)
        except RuntimeError as fault:
            raise DeviceFailed(" ".join(str(fault).split())[:200]) from None
        return error

    def slopes(self, camera: Camera, target: Tensor, options: OptimizeOptions) -> tuple[Tensor, float]:
        """Return slopes as `AxesGradients.rows`, and the RMS error of the picture."""
        import torch

        means, factors, logits, colors = self.tensors
        opacity = logits.sigmoid()
        covars = products(factors, factors.transpose(1, 2)).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        leaves = [tensor.detach().requires_grad_() for tensor in (means, capped(opacity), colors.clamp(min=0), covars)]
        rgb, alpha = self.draw(*leaves[:3], camera, options.rule, covars=leaves[3])
        slope, error = loss_slope(torch.cat([rgb, alpha], dim=2).detach(), target, options)
        # a sum, for `backward` with slopes loads an algebra system for seconds
        ((rgb * slope[..., :3]).sum() + (alpha * slope[..., 3:]).sum()).backward()
        by_means, by_opacity, by_color, by_covars = (leaf.grad for leaf in leaves)
        by_color = torch.where(colors >= 0, by_color, 0)
        # of the covariance M (I + E) (I + E) M^T: an entry off the diagonal stands for both
        full = (by_covars * by_covars.new_tensor([2, 1, 1, 2, 1, 2]))[:, SYMMETRIC].reshape(-1, 3, 3)
        turned = factors.transpose(1, 2)
        e = products(products(turned, full), factors).reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]
        e = e * e.new_tensor([1, 1, 1, 2, 2, 2])
        d = (turned * by_means[:, None, :]).sum(dim=2)
        by_logit = by_opacity * opacity * (1 - opacity)
        return torch.cat([d, e, by_logit[:, None], by_color], dim=1).T, float(error)

    def move(self, rows: Tensor, error: float, share: float, speed: float) -> None:
        """Step down ``rows`` (COUNT, K), as `OwnAxes.descend` does."""
        import torch

        rates, _ = self.rates(error, share, speed)
        floors, predicted = self.common_on(rows)
        way = self._adam(rows, self.moments, floors[:, None])
        if predicted is not None:
            way[SHARED] += predicted
        means, factors, logits, colors = self.tensors
        gain = (1 + self.spread / factors.square().sum(dim=1).clamp(min=1e-30)).clamp(max=9).sqrt()
        d = (way[:3].T * rates[0] * gain).clamp(-self.CLIPS[0], self.CLIPS[0])
        scaled = torch.cat([way[3:6] * rates[1], way[6:9] * rates[2]])[ENTRIES].T.reshape(-1, 3, 3)
        e = (scaled * (gain[:, :, None] * gain[:, None, :]).clamp(max=4)).clamp(-self.CLIPS[2], self.CLIPS[2])
        turned = products(factors, e)
        self.tensors = [
            means - (factors * d[:, None, :]).sum(dim=2),
            factors - turned + 0.5 * products(turned, e),
            logits - (way[9] * rates[3]).clamp(-self.CLIPS[1], self.CLIPS[1]),
            (colors - way[10:].T * rates[4]).clamp(min=self.darkest),
        ]
        for tensor, there in zip(self.tensors, self.there_sent, strict=True):
            tensor[self.fixed_sent] = there
        self._host = None

    def _adam(self, slopes: Tensor, moments: list[Tensor], floor: Any) -> Tensor:
        """Return Adam's directions, about 1 in size, and update its moments in place."""
        (first, second), (b1, b2) = moments, self.BETAS
        first.mul_(b1).add_(slopes, alpha=1 - b1)
        second.mul_(b2).addcmul_(slopes, slopes, value=1 - b2)
        way: Tensor = first / (1 - b1**self.step) / ((second / (1 - b2**self.step)).sqrt() + floor)
        return way

    def common_on(self, rows: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return what `OwnAxes.common` does: the divisors' floors (COUNT,), and what is predicted (KNOWN, K)."""
        import torch

        if not self.weakest:
            return rows.new_full((COUNT,), float(EPSILON)), None
        (every, count), (b1, b2) = sample_of(rows.shape[1]), self.BETAS
        some = [_sampled(tensor, every, count) for tensor in (rows, *self.moments)]
        towards = (b1 * some[1] + (1 - b1) * some[0]) / (1 - b1**self.step)
        sizes = ((b2 * some[2] + (1 - b2) * some[0].square()) / (1 - b2**self.step)).sqrt()
        few = sizes[:, :: max(count // MEDIAN, 1)]
        most = OUTLIER * torch.where(few > 0, few, torch.nan).nanmedian(dim=1).values.nan_to_num()
        floors = self.weakest * torch.minimum(sizes, most[:, None]).mean(dim=1) + float(EPSILON)
        if self.shared is None:
            return floors, None
        directions = (towards / (sizes + floors[:, None])).nan_to_num(0.0, 0.0, 0.0)
        plain, factor = directions[SHARED] @ self.solver.T, self.shared.factor
        self.shared.remember(plain.double().cpu().numpy())
        return floors, (factor * plain) @ self.features


def products(a: Tensor, b: Tensor) -> Tensor:
    """Return the products of matrices (K, 3, 3), which are too small for the library's."""
    return (a[:, :, :, None] * b[:, None, :, :]).sum(dim=2)


def _sampled(numbers: Tensor, every: int, count: int) -> Tensor:
    """Return of ``numbers`` (m, K) those of `sample_of`, (m, count)."""
    if every == 1:
        return numbers
    runs = numbers[:, : numbers.shape[1] // RUN * RUN].reshape(len(numbers), -1, RUN)
    return runs[:, ::every].reshape(len(numbers), count)


def loss_slope(image: Tensor, target: Tensor, options: OptimizeOptions) -> tuple[Tensor, Tensor]:
    """Return the slope of the loss by a picture (h, w, 4), and the picture's RMS error.

    The loss is that of `refine.loss` and `refine.texture`.
    """
    import torch

    weight = image.new_tensor([1, 1, 1, options.alpha])
    residual = image - target
    slope = weight * (options.l1 * residual.sign() + 2 * options.l2 * residual)
    error = ((weight * residual.square()).sum() / ((3 + options.alpha) * image[..., 0].numel())).sqrt()
    if options.texture > 0:
        off, seen = residual[..., :3], target[..., :3]
        mean = blur(torch.cat([off, seen, seen.square().sum(dim=2, keepdim=True)], dim=2))
        variance = (mean[..., 6] - mean[..., 3:6].square().sum(dim=2)).clamp(min=0) / 3
        fine = (SMOOTH / (SMOOTH + variance))[..., None] * (off - mean[..., :3])
        slope[..., :3] += 2 * options.texture * (fine - blur(fine))
    return slope, error


def blur(image: Tensor) -> Tensor:
    """Return an image (h, w, c) correlated with the window of `refine.ssim`, zeros beyond its border.

    Two products with band matrices: libraries of convolutions take a second to load.
    """
    import torch

    down, across = (_band(size, str(image.device)) for size in image.shape[:2])
    return torch.einsum("ij,jkc,lk->ilc", down, image, across)


@cache
def _band(size: int, device: str) -> Tensor:
    """Return the matrix (size, size) that blurs an axis."""
    import torch

    reach = len(KERNEL) // 2
    found = sum(
        np.diag(np.full(size - abs(n), KERNEL[n + reach]), n) for n in range(-reach, reach + 1) if abs(n) < size
    )
    return torch.from_numpy(np.asarray(found, np.float32)).to(device)
