"""The network in torch: identity at the start, symmetries, attention against a naive twin, gradients everywhere."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from network_models import FED, TINY, as_rows, scene

from vvgt_cli.cameras import default_views
from vvgt_cli.network import NAMED
from vvgt_cli.network.prepare import pack, prepare, view_arrays

torch = pytest.importorskip("torch")

from vvgt_cli.network import layers, model  # noqa: E402
from vvgt_cli.network.export import randomised  # noqa: E402
from vvgt_cli.network.model import Vvgt  # noqa: E402


def tensors(arrays):
    return {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}


def network(config=TINY, *, random=True):
    torch.manual_seed(0)
    made = Vvgt(config).eval()
    return randomised(made) if random else made


def run(model, gaussians, cameras, images):
    prepared = prepare(gaussians, cameras, images, model.config)
    with torch.inference_mode():
        return prepared.restore(model(tensors(prepared.arrays())).numpy())


@pytest.mark.parametrize("config", [TINY, FED, replace(TINY, variant="wo_vbm"), replace(TINY, variant="wo_vgf")])
def test_without_training_the_output_is_the_input(config):
    gaussians, cameras, images = scene()
    out = run(network(config, random=False), gaussians, cameras, images)
    assert np.abs(as_rows(out)[:, :6] - as_rows(gaussians)[:, :6]).max() == 0
    assert np.abs(pack(out) - pack(gaussians)).max() < 2e-7  # quaternions are normalised again


@pytest.mark.parametrize("config", [TINY, FED])
def test_permuting_gaussians_permutes_the_output(config):
    gaussians, cameras, images = scene(count=150)
    model = network(config)
    order = np.random.default_rng(1).permutation(150)
    out = as_rows(run(model, gaussians, cameras, images))
    # the splatter sums what it feeds in another order
    atol = 0 if config is TINY else 1e-4
    assert np.allclose(as_rows(run(model, gaussians.take(order), cameras, images)), out[order], atol=atol, rtol=0)
    assert np.abs(out - as_rows(gaussians)).max() > 0.01


def test_permuting_views_changes_nothing_and_their_images_matter():
    gaussians, cameras, images = scene(views=3)
    model = network()
    out = as_rows(run(model, gaussians, cameras, images))
    turned = as_rows(run(model, gaussians, [cameras[i] for i in (2, 0, 1)], images[[2, 0, 1]]))
    assert np.allclose(turned, out, atol=2e-5)
    crossed = as_rows(run(model, gaussians, cameras, images[[2, 0, 1]]))
    assert np.abs(crossed - out).max() > 1e-4  # views and cameras belong together


@pytest.mark.parametrize("config", [TINY, FED, replace(TINY, geometry=replace(TINY.geometry, head="direct")),
                                    replace(TINY, variant="wo_vgf"), replace(TINY, variant="wo_3dt")])  # fmt: skip
def test_gradients_reach_every_parameter(config):
    gaussians, cameras, images = scene()
    model = network(config).train()
    out = model(tensors(prepare(gaussians, cameras, images, config).arrays()))
    (out * torch.randn(out.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_queries_and_keys_are_normalised_within_views_and_over_all():
    torch.manual_seed(0)
    layer, tokens = randomised(model.AlternatingAttention(TINY.image)), torch.randn(2, 5, TINY.image.width)
    for block in (layer.frame, layer.whole):
        before, rows = block(tokens), slice(0, 2 * TINY.image.width)  # queries, then keys
        with torch.no_grad():
            block.attn.qkv.weight[rows] *= 3
            block.attn.qkv.bias[rows] *= 3
        assert torch.allclose(block(tokens), before, atol=1e-4)


def naive_epipolar(module, x, points, matrices, eyes, maps):
    """Eq. 7 with all keys of a token side by side, one token at a time, torch's own bilinear sampling."""
    uv, seen = layers.project(points, matrices)
    bias = module.bias(points, eyes, seen)
    query = module.query(module.norm(x))
    out = torch.zeros_like(x)
    for token in range(len(x)):
        logits, values = [], []
        for view, (scale, of_scale) in product(range(len(matrices)), enumerate(maps)):
            if not seen[view, token]:
                continue
            for layer in range(module.layers):
                image = of_scale[view, :, :, layer].permute(2, 0, 1)[None]  # (1, c, h, w)
                number = scale * module.layers + layer
                kv = module.key_values[number](module.map_norms[number](image[0].permute(1, 2, 0))).permute(2, 0, 1)
                place = (2 * uv[view, token] - 1).reshape(1, 1, 1, 2)
                sampled = torch.nn.functional.grid_sample(
                    kv[None], place, mode="bilinear", padding_mode="border", align_corners=False
                )[0, :, 0, 0]
                logits.append(query[token] @ sampled[: module.inner] / module.inner**0.5 + bias[view, token])
                values.append(sampled[module.inner :])
        if logits:
            out[token] = module.out(torch.softmax(torch.stack(logits), dim=0) @ torch.stack(values))
    return out


def epipolar_case(points):
    torch.manual_seed(1)
    module = randomised(layers.EpipolarCrossAttention(16, 8, 2, 8))
    views = tensors(view_arrays(default_views("train", 4, size=40)))
    maps = [torch.randn(4, 3 * f, 3 * f, 2, 8) for f in (1, 2, 4)]
    return module, torch.randn(len(points), 16), points, views["matrices"], views["eyes"], maps


def test_epipolar_attention_against_a_materialised_twin():
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1.6, 1.6, (40, 3)).astype(np.float32))
    points = torch.cat([points, torch.tensor([[0.0, 0.0, 40.0], [0.0, 0.0, 2.99]])])  # seen by few or none
    module, *rest = epipolar_case(points)
    with torch.no_grad():
        seen = layers.project(points, rest[2])[1]
        assert 0 < seen.float().mean() < 1
        assert not seen[:, -2].any()
        assert torch.allclose(module(*rest), naive_epipolar(module, *rest), atol=1e-5)
        assert (module(*rest)[-2] == 0).all()


def test_projection_against_the_cameras():
    cameras = default_views("test", size=50)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 3)).astype(np.float32)
    uv, seen = layers.project(torch.from_numpy(points), tensors(view_arrays(cameras))["matrices"])
    for i, c in enumerate(cameras):
        x, y, z = (points @ c.rotation.T + c.translation).T
        u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
        inside = (z > 0.01) & (u >= 0) & (u <= c.width) & (v >= 0) & (v <= c.height)
        assert np.array_equal(seen[i].numpy(), inside)
        assert np.allclose(uv[i].numpy()[inside], np.column_stack([u / c.width, v / c.height])[inside], atol=1e-5)


def test_the_head_moves_along_the_gaussians_own_axes():
    gaussians, _, _ = scene(count=20)
    rows = torch.from_numpy(pack(gaussians))
    module = model.GaussianHead(TINY.geometry)
    with torch.no_grad():
        module.last.bias[:3] = torch.tensor([50.0, 0.0, 0.0])  # as far along the first axis as it goes
        out = module(torch.randn(20, 8), rows)
    moved = (out - rows)[:, :3]
    axis = model.rotation(rows[:, 6:10])[:, :, 0]
    assert torch.allclose(moved, 2 * rows[:, 3:4].exp() * axis, atol=1e-6)
    assert torch.allclose(out[:, 3:], rows[:, 3:], atol=1e-6)


def test_small_is_small():
    assert 5.0e6 < sum(parameter.numel() for parameter in Vvgt(NAMED["small"]).parameters()) < 6.2e6
