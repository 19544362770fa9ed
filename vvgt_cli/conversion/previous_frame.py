"""Warm start of a frame from the previous one: where they agree, Gaussians stay and blocks of views are reused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import BLOCK, Blocks, Camera
from vvgt_cli.conversion.changes import Changes, changes
from vvgt_cli.conversion.plan import Plan, WarmStart
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, TrainingViews
from vvgt_cli.conversion.stages.refinement import Refinement, refine, widen_small
from vvgt_cli.defaults import WARM_STEPS
from vvgt_cli.field.field import Picture, ViewRenderer
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians, Rule, as_stored
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.score.views import Views

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings


ROUNDS = 2  # of `WARM_STEPS` at most
LEVEL = 0.25 / 255  # difference of a pixel that counts as none
VIEWS = 18  # training views per frame, which take turns
WORSE = 0.2  # dB on the check views below the last cold frame, beyond which a frame starts cold
FAR = 6.0  # the same before any step
A_SET = 14 * 4  # bytes of a Gaussian without harmonics, which are 12 each


@dataclass(frozen=True)
class _Frame:
    """The state that a frame passes to the next.

    Attributes:
        source: source of the frame.
        gaussians: Gaussians in the box frame, as the file holds them.
        psnr: dB on the check views of the last frame that started cold.
        cameras, rule, settings: cameras, drawing rule and settings of the training views.
        shown: for each turn of the views, the Gaussians when they were drawn last.
    """

    source: StyledVolume
    gaussians: Gaussians
    psnr: float
    cameras: list[Camera]
    rule: Rule
    settings: RenderSettings
    shown: tuple[Gaussians, ...]


def previous_frame(request: ConvertRequest, shards: int = 1) -> PreviousFrame | None:
    """Return the warm start of a series in ``shards`` shards; None where each frame is converted from scratch."""
    cold = request.live or request.checkpoint or request.fit.ended or shards > 1
    return None if cold else PreviousFrame(request.fit.screen)


class PreviousFrame(WarmStart):
    """The Gaussians of the previous frame, and its pictures, up to ``size`` pixels along an edge."""

    name = "starting from the previous frame"

    def __init__(self, size: int) -> None:
        """Start without a previous frame."""
        self._last: _Frame | None = None
        self._pictures = RememberedViews(size)
        self._turn = 0
        self._moved: int | None = None  # number of Gaussians that differ from the previous frame

    def renderer(self, views: ViewRenderer) -> ViewRenderer:
        """Implement `WarmStart.renderer`."""
        self._pictures.views = views
        return self._pictures

    def facts(self) -> dict[str, int]:
        """Return the number of Gaussians of the last frame that differ from the previous one."""
        return {} if self._moved is None else {"moved": self._moved}

    def memory(self, plan: Plan, fit: FitOptions) -> tuple[int, Callable[[Workload], float]]:
        """Implement `WarmStart.memory`."""
        turns = max((max(s.count // VIEWS, 1) for s in plan.stages if isinstance(s, TrainingViews)), default=-1)
        there = {id(one) for one in (self._last.gaussians, *self._last.shown)} if self._last else ()
        sets = max(turns + 1 - len(there), 0)
        pictures = self._pictures.new_bytes([view for stage in plan.stages for view in stage.views(fit)]) if sets else 0
        return pictures, lambda workload: sets * workload.gaussians * (A_SET + 12 * ((workload.degree + 1) ** 2 - 1))

    def obstacle(self, work: Work, plan: Plan, request: ConvertRequest) -> str | None:
        """Implement `WarmStart.obstacle`."""
        self._moved = None
        last, self._last = self._last, None
        lighting = work.field.source.lighting
        finer = work.field.source.layers[0].volume.dims != work.field.source.volume.dims  # for a layer's sake
        if last is None or finer or (lighting is not None and lighting.sky is not None):  # shadows reach far
            self._pictures.invalidate(None)
            return ""
        with work.run.stage("differences") as stage:
            differing = changes(last.source, work.field.source)
            free = differing.meet(last.gaussians)
            self._pictures.invalidate(differing)
            stage.note = f"{differing.blocks.mean():.1%} of the volume, {int(free.sum())} of {len(free)} Gaussians"
        work.gaussians, shown = last.gaussians, last.shown
        if differing.blocks.any():  # else no view is drawn
            if worse := self._refine(work, last, differing, free):
                return worse
            turn = self._turn % len(shown)
            shown = (*shown[:turn], work.current(), *shown[turn + 1 :])
            self._turn += 1
        self._last = replace(last, source=work.field.source, gaussians=work.current(), shown=shown)
        self._moved = _count_differing(last.gaussians, work.current())
        return None

    def keep(self, work: Work, plan: Plan) -> None:
        """Store a frame that started cold, if it was fitted to views."""
        if not any(isinstance(stage, Refinement) for stage in plan.stages) or work.check is None:
            return
        if work.train is not None and work.train_rule is not None and work.train_settings is not None:
            made = work.current()
            cameras = work.train.cameras
            shown = (made,) * max(len(cameras) // VIEWS, 1)
            self._last = _Frame(
                work.field.source, made, work.psnr(made), cameras, work.train_rule, work.train_settings, shown
            )

    def _refine(self, work: Work, last: _Frame, differing: Changes, free: np.ndarray) -> str | None:
        """Refine the Gaussians that are ``free`` (K,) bool; return why they are not good enough, None if they are."""
        from vvgt_cli.dvr import render_views

        turn, turns = self._turn % len(last.shown), len(last.shown)
        cameras = last.cameras[turn::turns]
        work.train_rule = last.rule
        check = CheckViews()
        work.field.views.expect([*check.views(work.fit), *(Picture(camera, last.settings) for camera in cameras)])
        check.run(work)
        if work.psnr(last.gaussians) < last.psnr - FAR:
            return "the frame differs too much"
        with work.run.stage("views") as stage:
            before = [self._pictures.last(Picture(camera, last.settings)) for camera in cameras]
            images = render_views(work.field.views, cameras, last.settings)
            for camera, image, old in zip(cameras, images, before, strict=True):
                _keep_unchanged(image, old, last.shown[turn], camera, last.rule)
            stage.note = f"{len(cameras)} of {cameras[0].width} px to fit to, where they differ from the previous frame"
        assert work.check is not None
        compared, psnr = _changed_blocks(work.check, differing), 0.0
        asked = work.fit.steps
        left = ROUNDS * WARM_STEPS if asked is None else min(asked, ROUNDS * WARM_STEPS)
        while left > 0:
            steps = min(WARM_STEPS, left)
            left -= steps
            options = OptimizeOptions.of(
                "axes", steps=steps, rule=last.rule, check_rule=work.rule, seed=work.fit.seed, check_every=WARM_STEPS
            )
            result = refine(work.run, work.current(), Views(cameras, images), compared, options, free=free)
            result = as_stored(widen_small(result, work.fit.screen)[0])
            work.gaussians = _moved(last.gaussians, result, free)
            psnr = work.psnr(work.gaussians)
            if psnr >= last.psnr - WORSE or work.run.report.interrupted:
                return None
        return f"{last.psnr - psnr:.1f} dB worse on the check views than the last frame without"


def _keep_unchanged(image: np.ndarray, old: np.ndarray | None, shown: Gaussians, camera: Camera, rule: Rule) -> None:
    """Set unchanged pixels of a view (h, w, 4) to those of the Gaussians, so that descent keeps them."""
    from vvgt_cli.splat import render

    if old is not None:
        same = (np.abs(image - old) <= LEVEL).all(axis=2)
        image[same] = render(shown, camera, rule)[same]


def _moved(start: Gaussians, result: Gaussians, free: np.ndarray) -> Gaussians:
    """Return the rows of ``result`` where ``free`` (K,) bool, else those of ``start``, bit for bit."""
    arrays = {}
    for name, array in start.arrays().items():
        arrays[name] = array.copy()
        arrays[name][free] = getattr(result, name)[free]
    return Gaussians(**arrays)


def _count_differing(first: Gaussians, second: Gaussians) -> int:
    """Return the number of Gaussians that differ."""
    pairs = zip(first.arrays().values(), second.arrays().values(), strict=True)
    return int(np.any([(a != b).reshape(len(first), -1).any(axis=1) for a, b in pairs], axis=0).sum())


def _changed_blocks(views: Views, differing: Changes) -> Views:
    """Return the blocks of views that show differences, to compare; all views where none does."""
    cameras, images, blocks = [], [], []
    for k, camera in enumerate(views.cameras):
        shown = differing.seen_by(camera)
        shown[camera.height // BLOCK :], shown[:, camera.width // BLOCK :] = (
            False,
            False,
        )  # blocks cut by the picture's edge
        numbers, image = np.flatnonzero(shown), views.images[k]
        if views.blocks is None:
            image = Blocks(camera.width, camera.height, numbers).pick(image)
        else:
            mine = views.blocks[k].numbers
            numbers = np.intersect1d(numbers, mine)
            image = image.reshape(-1, BLOCK, BLOCK, 4)[np.searchsorted(mine, numbers)].reshape(-1, BLOCK, 4)
        if len(numbers):
            cameras.append(camera)
            images.append(image)
            blocks.append(Blocks(camera.width, camera.height, numbers))
    return Views(cameras, images, blocks) if cameras else views  # type: ignore[arg-type] # of several heights


class RememberedViews:
    """Views of a frame that reuse unchanged blocks of pixels of the previous frame.

    Attributes:
        largest: pixels along an edge; larger pictures are not cached.
        views: views of the frame that is being converted.
    """

    def __init__(self, largest: int, views: ViewRenderer | None = None) -> None:
        """Start with an empty cache."""
        self.largest, self.views = largest, views
        self._kept: dict[str, tuple[Camera, np.ndarray, np.ndarray]] = {}  # camera, picture, (rows, columns) bool

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Implement `ViewRenderer.expect`."""
        missing = [picture._replace(blocks=self.missing(picture)) for picture in pictures]
        assert self.views is not None
        self.views.expect([one for one in missing if one.blocks is None or len(one.blocks.numbers)])

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Implement `ViewRenderer.view`."""
        picture = Picture(camera, settings, blocks)
        missing = self.missing(picture)
        if missing is not None and not len(missing.numbers):
            image = np.zeros((camera.height, camera.width, 4), np.float32)
        else:
            assert self.views is not None
            image = self.views.view(camera, settings, missing)
        return self.put(picture, missing, image)

    def forget(self, picture: Picture) -> None:
        """Keep the picture, for the next frame."""

    def invalidate(self, changes: Changes | None) -> None:
        """Discard cached blocks that show a change; None discards all pictures."""
        if changes is None:
            self._kept.clear()
        for camera, _, known in self._kept.values():
            known &= ~changes.seen_by(camera) if changes else False

    def last(self, view: Picture) -> np.ndarray | None:
        """Return a cached picture (h, w, 4), whose blocks may be of different frames; None without one."""
        kept = self._kept.get(_key(view))
        return None if kept is None else kept[1].copy()

    def new_bytes(self, views: Sequence[Picture]) -> int:
        """Return the bytes that caching ``views`` would add."""
        sizes = {_key(view): (view.camera.width, view.camera.height) for view in views}
        return sum(16 * w * h for key, (w, h) in sizes.items() if key not in self._kept and max(w, h) <= self.largest)

    def missing(self, view: Picture) -> Blocks | None:
        """Return the blocks of a picture that have to be drawn; None for the whole."""
        kept = self._kept.get(_key(view))
        if kept is None:
            return view.blocks
        numbers = np.flatnonzero(~kept[2]) if view.blocks is None else view.blocks.numbers
        return Blocks(view.camera.width, view.camera.height, numbers[~kept[2].ravel()[numbers]])

    def put(self, view: Picture, drawn: Blocks | None, image: np.ndarray) -> np.ndarray:
        """Cache the blocks ``drawn`` in ``image`` (h, w, 4), and return the picture with the cached ones."""
        camera, key = view.camera, _key(view)
        if max(camera.width, camera.height) > self.largest:
            return image
        if key not in self._kept:
            known = np.zeros((-(-camera.height // BLOCK), -(-camera.width // BLOCK)), bool)
            self._kept[key] = camera, np.zeros_like(image), known
        _, whole, known = self._kept[key]
        mask = np.ones(image.shape[:2], bool) if drawn is None else drawn.mask()
        whole[mask] = image[mask]
        known.flat[slice(None) if drawn is None else drawn.numbers] = True
        if view.blocks is None:
            return whole.copy()
        return np.where(view.blocks.mask()[..., None], whole, np.float32(0))


def _key(view: Picture) -> str:
    return view._replace(blocks=None).key
