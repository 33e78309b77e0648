"""Loss terms: published reference values, slow oracles, masks, and what minimises them."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core import config, geometry
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.task import Maps, tasks_of, terms_of
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.model import Model, Outputs
from mtl_bench.tasks.depth.losses import (
    PhotometricError,
    hint_error,
    photometric_loss,
    smoothness_loss,
)
from mtl_bench.tasks.panoptic.losses import center_loss, offset_loss, semantic_loss

F64 = torch.float64
TASKS = ("panoptic", "depth")


def pattern(a: int, b: int, c: int, m: int) -> Tensor:
    """((a i + b j + c k) mod m) / (m - 1) for row i, column j, channel k: [1,3,12,16]."""
    k, i, j = torch.meshgrid(*(torch.arange(n) for n in (3, 12, 16)), indexing="ij")
    return (((a * i + b * j + c * k) % m).to(F64) / (m - 1))[None]


# --- SSIM + L1 ------------------------------------------------------------------------------------


def slow_dissimilarity(x: Tensor, y: Tensor) -> Tensor:
    """(1 - SSIM) / 2 per channel, written as the definition: the oracle."""

    def mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(F.pad(image, (1, 1, 1, 1), mode="reflect"), 3, 1)

    var_x, var_y = mean(x * x) - mean(x) ** 2, mean(y * y) - mean(y) ** 2
    top = (2 * mean(x) * mean(y) + 1e-4) * (2 * (mean(x * y) - mean(x) * mean(y)) + 9e-4)
    bottom = (mean(x) ** 2 + mean(y) ** 2 + 1e-4) * (var_x + var_y + 9e-4)
    return ((1 - top / bottom) / 2).clamp(0, 1)


def slow_error(x: Tensor, y: Tensor, weight: float = 0.85) -> Tensor:
    return (weight * slow_dissimilarity(x, y) + (1 - weight) * (x - y).abs()).mean(1)


def test_ssim_and_photometric_reference_values() -> None:
    x, y = pattern(7, 13, 5, 17), pattern(3, 5, 11, 19)
    ssim = slow_dissimilarity(x, y)
    assert ssim.mean().item() == pytest.approx(0.496397005096, abs=1e-12)
    assert ssim[0, 0, 0, 0].item() == pytest.approx(0.531315388660, abs=1e-12)
    assert ssim[0, 2, 11, 15].item() == pytest.approx(0.485067732942, abs=1e-12)
    torch.testing.assert_close(PhotometricError(y, 1.0)(x), ssim.mean(1), rtol=0, atol=1e-13)
    error = PhotometricError(y)(x)
    assert error.mean().item() == pytest.approx(0.473852601901, abs=1e-12)
    assert error[0, 5, 7].item() == pytest.approx(0.455001160473, abs=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.85, 1.0])
def test_photometric_error_and_gradient_equal_the_definition(weight: float) -> None:
    torch.manual_seed(0)
    target, image = torch.rand(2, 2, 3, 5, 7, dtype=F64)
    image.requires_grad_()
    ours, slow = PhotometricError(target, weight)(image), slow_error(image, target, weight)
    torch.testing.assert_close(ours, slow, rtol=0, atol=1e-12)
    upstream = torch.rand_like(ours)
    ours_grad, slow_grad = (torch.autograd.grad(e, image, upstream)[0] for e in (ours, slow))
    torch.testing.assert_close(ours_grad, slow_grad, rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(PhotometricError(target, weight), image)


def test_photometric_error_is_zero_between_equal_images() -> None:
    image = torch.rand(2, 3, 16, 16)
    for same in (image, torch.full_like(image, 0.7), torch.zeros_like(image)):
        error = PhotometricError(same)(same)
        assert error.min() >= 0
        assert error.max() < 1e-3  # float32 keeps a variance to about 1e-7


def test_photometric_error_takes_several_gradients_at_once() -> None:
    """Methods that want one gradient per task may batch their backward passes."""
    image = torch.rand(1, 3, 6, 6, requires_grad=True)
    error = PhotometricError(torch.rand(1, 3, 6, 6))(image)
    upstream = torch.rand(4, *error.shape)
    (batched,) = torch.autograd.grad(
        error, image, upstream, is_grads_batched=True, retain_graph=True
    )
    single = [torch.autograd.grad(error, image, g, retain_graph=True)[0] for g in upstream]
    torch.testing.assert_close(batched, torch.stack(single))


# --- photometric loss -----------------------------------------------------------------------------


class Scene:
    """A textured plane seen by three cameras; every frame is evaluated, not interpolated."""

    def __init__(self, height: int = 24, width: int = 48, batch: int = 1):
        K = torch.tensor([[40.0, 0, width / 2 - 0.5], [0, 40, height / 2 - 0.5], [0, 0, 1]])
        self.K = K.to(F64).repeat(batch, 1, 1)
        motion = torch.tensor([[0.15, 0, 0.3, 0, 0.01, 0], [-0.15, 0, -0.3, 0, -0.01, 0]])
        self.transforms = geometry.pose_from_vector(motion.to(F64)).repeat(batch, 1, 1, 1)
        normal = F.normalize(torch.tensor([0.1, 0.5, 0.8], dtype=F64), dim=0)
        self.plane, self.distance = normal, 4.0
        self.shape = (batch, 1, height, width)
        self.target, self.depth = self.view(torch.eye(4, dtype=F64).repeat(batch, 1, 1))
        self.inverse = 1 / self.depth
        self.context = torch.stack([self.view(t)[0] for t in self.transforms.unbind(1)], 1)
        self.mask = torch.ones(batch, height, width, dtype=torch.bool)

    def view(self, transform_B44: Tensor) -> tuple[Tensor, Tensor]:
        """Image and depth of the camera that this transform leads to."""
        R, t = transform_B44[:, :3, :3], transform_B44[:, :3, 3:]
        rays = geometry.back_project(torch.ones(self.shape, dtype=F64), self.K).flatten(2)
        turned, origin = R.mT @ rays, -R.mT @ t  # in the target's frame
        n = self.plane.view(1, 1, 3)
        depth = (self.distance - n @ origin) / (n @ turned)
        x, y, _ = (origin + turned * depth).unbind(1)
        waves = [(2.1, 0.3, 0.0), (0.4, 2.7, 1.0), (1.7, -1.9, 2.0)]
        image = torch.stack([0.5 + 0.4 * torch.sin(a * x + b * y + c) for a, b, c in waves], 1)
        return image.unflatten(-1, self.shape[2:]), depth.unflatten(-1, self.shape[2:])

    def loss(
        self,
        inverse: Tensor | None = None,
        automask: bool = False,
        hints: float = 0.0,
        **changed: Tensor,
    ) -> Tensor:
        frames = {"context_BN3HW": self.context, "transforms_BN44": self.transforms} | changed
        return photometric_loss(
            self.target,
            inverse_SB1HW=[self.inverse if inverse is None else inverse],
            K_B33=self.K,
            **{"mask_BHW": self.mask} | frames,
            automask=automask,
            hints=hints,
        )


@pytest.mark.parametrize("automask", [False, True])
def test_true_depth_and_pose_minimise_the_photometric_loss(automask: bool) -> None:
    scene = Scene()
    best = scene.loss(automask=automask).item()
    assert best < 0.01
    for factor in (0.8, 0.95, 1.05, 1.25):
        assert scene.loss(scene.inverse * factor, automask=automask).item() > 1.2 * best
    wrong = scene.transforms.clone()
    wrong[:, :, 0, 3] *= -1
    assert scene.loss(automask=automask, transforms_BN44=wrong).item() > 3 * best


def test_photometric_gradient_leads_to_the_true_scale() -> None:
    scene = Scene()
    log_factor = torch.tensor(math.log(1.3), dtype=F64, requires_grad=True)
    optimiser = torch.optim.Adam([log_factor], lr=0.02)
    for _ in range(40):
        optimiser.zero_grad()
        scene.loss(scene.inverse * log_factor.exp()).backward()
        optimiser.step()
    assert log_factor.exp().item() == pytest.approx(1, abs=0.03)


def test_photometric_gradient_reaches_depth_and_pose() -> None:
    scene = Scene()
    inverse = (scene.inverse * 1.1).requires_grad_()
    transforms = scene.transforms.clone().requires_grad_()
    scene.loss(inverse, automask=True, transforms_BN44=transforms).backward()
    for leaf in (inverse, transforms):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().sum() > 0


def slow_interior(mask_BHW: Tensor) -> Tensor:
    """Pixels whose neighbours in the image are all in the mask."""
    inner = mask_BHW.clone()
    for b, y, x in (~mask_BHW).nonzero().tolist():
        inner[b, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = False
    return inner


def test_photometric_loss_equals_a_slow_one() -> None:
    torch.manual_seed(1)
    scene = Scene(batch=2)
    scene.target = torch.rand_like(scene.target)
    scene.mask = torch.rand(scene.mask.shape) > 0.03
    scales = [scene.inverse * factor for factor in (0.6, 1.0, 1.7)]
    expected = {False: 0.0, True: 0.0}
    for inverse in scales:
        candidates, views = [], []
        for n in range(2):
            warped, valid = geometry.warp(
                scene.context[:, n], 1 / inverse, scene.transforms[:, n], scene.K, "border"
            )
            error = slow_error(warped, scene.target)
            candidates.append(torch.where(valid[:, 0], error, torch.inf))
            views.append(valid[:, 0])
        still = [slow_error(scene.context[:, n], scene.target) for n in range(2)]
        counts = (views[0] | views[1]) & slow_interior(scene.mask)
        assert 0 < counts.sum() < scene.mask.sum()
        for automask in (False, True):
            chosen = torch.stack(candidates + still * automask).amin(0)
            expected[automask] += chosen[counts].mean().item() / 3
    for automask in (False, True):
        loss = photometric_loss(
            scene.target,
            scene.context,
            scales,
            scene.K,
            scene.mask,
            scene.transforms,
            automask=automask,
        )
        assert loss.item() == pytest.approx(expected[automask], abs=1e-12)


def test_masked_pixels_do_not_count() -> None:
    scene = Scene()
    scene.mask[:, :, 30:] = False
    clean = scene.loss().item()
    scene.target[..., 32:] = 0.0  # further right than the window of a pixel that counts
    assert scene.loss().item() == pytest.approx(clean, abs=1e-12)
    scene.target[..., 10:12] = 0.0
    assert scene.loss().item() > clean


def test_invalid_projection_is_no_candidate() -> None:
    """A dark target: black out-of-view samples would win every minimum if they took part."""
    scene = Scene()
    scene.target = torch.zeros_like(scene.target)
    sideways = torch.eye(4, dtype=F64).repeat(1, 2, 1, 1)
    sideways[:, 0, 0, 3] = 1e3  # the first context frame shows nothing of the target
    one = scene.loss(transforms_BN44=sideways)
    other_only = scene.loss(context_BN3HW=scene.context[:, 1:], transforms_BN44=sideways[:, 1:])
    assert one.item() == pytest.approx(other_only.item(), abs=1e-12)
    assert one.item() > 0.1


@pytest.mark.parametrize("automask", [False, True])
def test_nothing_in_view_is_no_loss(automask: bool) -> None:
    scene = Scene()
    away = scene.transforms.clone()
    away[..., 0, 3] = 1e3
    for changed in ({"transforms_BN44": away}, {"mask_BHW": torch.zeros_like(scene.mask)}):
        assert scene.loss(automask=automask, **changed) is None


def test_a_scale_with_nothing_in_view_is_in_no_mean() -> None:
    scene = Scene()
    aside = torch.eye(4, dtype=F64).repeat(1, 2, 1, 1)
    aside[..., 0, 3] = 0.5
    near = torch.full_like(scene.inverse, 1e6)  # so near that no neighbour has it in view
    frames = (scene.K, scene.mask, aside)
    one, both = (
        photometric_loss(scene.target, scene.context, scales, *frames, automask=False)
        for scales in ([scene.inverse], [scene.inverse, near])
    )
    assert both is not None
    assert one is not None
    assert both.item() == pytest.approx(one.item(), abs=1e-12)


def test_automask_silences_what_does_not_move() -> None:
    """A frame equal to its neighbours: every depth is as good, so no depth gets a gradient."""
    scene = Scene()
    still = scene.target[:, None].expand_as(scene.context)
    inverse = scene.inverse.clone().requires_grad_()
    loss = scene.loss(inverse, automask=True, context_BN3HW=still)
    assert loss.item() == pytest.approx(0, abs=1e-12)
    (grad,) = torch.autograd.grad(loss, inverse)
    assert (grad == 0).all()
    loss = scene.loss(inverse, automask=False, context_BN3HW=still)
    assert loss.item() > 0.01
    (grad,) = torch.autograd.grad(loss, inverse)
    assert grad.abs().sum() > 0


def test_a_tie_goes_to_the_unwarped_frame() -> None:
    """A pose of zero warps nothing, to the last bit: an equal error pulls on no pose."""
    torch.manual_seed(4)
    target, context = torch.rand(1, 3, 9, 17), torch.rand(1, 1, 3, 9, 17)
    mask, one = torch.ones(1, 9, 17, dtype=torch.bool), torch.ones(1, 1, 9, 17)
    still, K = torch.eye(4).repeat(1, 1, 1, 1).requires_grad_(), torch.eye(3)[None]
    for automask in (True, False):
        loss = photometric_loss(target, context, [one], K, mask, still, automask=automask)
        (grad,) = torch.autograd.grad(loss, still)
        assert bool((grad == 0).all()) == automask


# --- hints ----------------------------------------------------------------------------------------


def hint_gradient(scene: Scene, factor: float) -> Tensor:
    """Of the hints' part of the loss, with respect to the logarithm of a depth so many times too
    far: positive where a nearer one is better."""
    log = (scene.depth * factor).log().requires_grad_()
    with_hints, without = (
        scene.loss((-log).exp(), hints=weight, automask=False) for weight in (2.0, 0.0)
    )
    (grad,) = torch.autograd.grad(with_hints - without, log)
    return grad


@pytest.mark.parametrize(("factor", "sign"), [(1.3, 1), (0.75, -1)])
def test_hints_lead_to_the_true_depth_and_the_more_the_farther_it_is(factor, sign) -> None:
    scene = Scene(batch=4)
    grad = hint_gradient(scene, factor)
    assert (grad.sign() == sign).double().mean() > 0.8
    relative = scene.depth / scene.depth[0].median()
    strength = (grad / relative.clamp(0.25, 5)).abs()[grad != 0]
    torch.testing.assert_close(strength, torch.full_like(strength, float(strength[0])))


def test_hints_leave_the_true_depth_alone() -> None:
    assert hint_gradient(Scene(batch=4), 1.0).sign().abs().mean() < 0.02


def test_hints_have_finite_gradients_where_nothing_is_in_view() -> None:
    scene = Scene()
    inverse = (scene.inverse * 1.1).requires_grad_()
    aside = scene.transforms.clone()
    aside[..., 0, 3] = 2.0  # most of the frame is in no neighbour's view
    scene.loss(inverse, hints=0.1, transforms_BN44=aside).backward()
    assert inverse.grad is not None
    assert inverse.grad.isfinite().all()
    assert 0 < (inverse.grad != 0).double().mean() < 0.9


def test_hint_error_is_the_distance_to_the_better_of_two_depths() -> None:
    torch.manual_seed(5)
    depth = 1 + torch.rand(2, 1, 3, 4)
    own, farther, nearer = torch.rand(3, 2, 3, 4)
    nearer[0, 0, 0] = torch.inf

    def rebuilt(tried: Tensor) -> tuple[Tensor, Tensor]:
        step = (tried / depth).log().flatten(1)
        torch.testing.assert_close(step.abs(), torch.tensor([[0.2], [0.4]]).expand(2, 12))
        return farther if (step > 0).all() else nearer, torch.ones(2, 3, 4, dtype=torch.bool)

    found = hint_error(depth, own, rebuilt)
    for b, step in enumerate((0.2, 0.4)):
        better = torch.minimum(farther[b], nearer[b]) < own[b]
        weight = depth[b, 0] / depth[b, 0].mean()
        torch.testing.assert_close(found[b], step * better * weight)
    assert 0 < (found > 0).double().mean() < 1


# --- smoothness -----------------------------------------------------------------------------------


def test_smoothness_of_a_ramp() -> None:
    inverse = torch.arange(1.0, 9).expand(1, 1, 4, 8).to(F64)  # mean 4.5, step 1
    image = torch.zeros(1, 3, 4, 8, dtype=F64)
    mask = torch.ones(1, 4, 8, dtype=torch.bool)
    flat = smoothness_loss([inverse], [0], image, mask).item()
    assert flat == pytest.approx(1 / 4.5)
    assert smoothness_loss([inverse * 7], [0], image, mask).item() == pytest.approx(flat)
    assert smoothness_loss([inverse.mT.contiguous()], [0], image.mT, mask.mT).item() == flat
    three = smoothness_loss([inverse] * 3, [0, 1, 2], image, mask).item()
    assert three == pytest.approx(flat * (1 + 1 / 2 + 1 / 4) / 3)
    image[..., 4:] = 0.5  # one of the seven columns of differences has an edge
    edge = smoothness_loss([inverse], [0], image, mask).item()
    assert edge == pytest.approx((6 + math.exp(-0.5)) / 7 / 4.5)


def test_smoothness_mask_is_at_the_left_and_top_pixel() -> None:
    inverse = torch.ones(1, 1, 4, 8, dtype=F64)
    inverse[..., 2, 5] = 2
    image, mask = torch.zeros(1, 3, 4, 8, dtype=F64), torch.ones(1, 4, 8, dtype=torch.bool)
    mask[0, 2, 5] = False
    step = 1 / inverse.mean()
    expected = step / (mask[..., :-1].sum()) + step / (mask[:, :-1].sum())
    assert smoothness_loss([inverse], [0], image, mask).item() == pytest.approx(expected.item())
    mask[0, 2, 4] = mask[0, 1, 5] = False
    assert smoothness_loss([inverse], [0], image, mask).item() == 0


# --- panoptic terms -------------------------------------------------------------------------------


def test_semantic_loss_keeps_the_hardest_valid_pixels() -> None:
    torch.manual_seed(2)
    logits = torch.randn(2, 5, 4, 5, dtype=F64)
    target = torch.randint(0, 5, (2, 4, 5))
    target[0, 0], target[1, 1, 2] = 255, 255
    weight = torch.ones(2, 4, 5, dtype=F64)
    weight[:, 2] = 3
    weight[1, 3] = 0
    log_p = logits.log_softmax(1)
    rows = [
        (log_p[b, target[b, i, j], i, j].item(), weight[b, i, j].item())
        for b in range(2)
        for i in range(4)
        for j in range(5)
        if target[b, i, j] != 255 and weight[b, i, j] > 0
    ]
    assert len(rows) == 29
    for fraction, k in ((0.2, 6), (1.0, 29), (1e-9, 1)):
        hardest = sorted(rows)[:k]
        expected = sum(-w * p for p, w in hardest) / k
        loss = semantic_loss(logits, target, weight, fraction)
        assert loss.item() == pytest.approx(expected, abs=1e-12)


def test_semantic_loss_counts_ties_and_ignores_void() -> None:
    logits = torch.zeros(1, 4, 2, 3, requires_grad=True)
    target = torch.zeros(1, 2, 3, dtype=torch.long)
    target[0, 1] = 255
    loss = semantic_loss(logits, target, torch.ones(1, 2, 3), 0.2)
    assert loss.item() == pytest.approx(math.log(4))
    (grad,) = torch.autograd.grad(loss, logits)
    assert (grad[:, :, 0] != 0).all()
    assert (grad[:, :, 1] == 0).all()


def test_center_and_offset_values() -> None:
    center, target = torch.tensor([0.5, 0.0, 1.0, 0.25]), torch.tensor([1.0, 0, 0, 0.25])
    weight = torch.tensor([1.0, 1, 0, 2])
    shaped = (t.view(1, 1, 2, 2) for t in (center, target, weight))
    assert center_loss(*shaped).item() == pytest.approx(0.25 / 4)
    offset = torch.tensor([[1.0, -2], [3, 4]]).view(1, 2, 1, 2)  # (y, x) of two pixels
    zero, weight = torch.zeros_like(offset), torch.tensor([1.0, 0]).view(1, 1, 1, 2)
    assert offset_loss(offset, zero, weight).item() == 4.0  # |1| + |3|
    assert offset_loss(offset, zero, torch.ones(1, 1, 1, 2)).item() == 5.0


# --- all of them ----------------------------------------------------------------------------------


def named(*names: str, loss: config.Loss | None = None):
    return tasks_of(config.Recipe(loss=loss or config.Loss()), names, CITYSCAPES20)


def test_terms_are_the_papers() -> None:
    terms = terms_of(named(*TASKS))
    weights = {term.name: term.fixed_weight for term in terms}
    assert weights == {
        "semantic": 1,
        "center": 200,
        "offset": 0.01,
        "photometric": 1,
        "smoothness": 0.001,
    }
    assert [t.name for t in terms if t.kind == "classification"] == ["semantic"]
    assert terms_of(named(*reversed(TASKS))) == terms
    assert [t.name for t in terms_of(named("depth"))] == ["photometric", "smoothness"]
    with pytest.raises(ValueError, match="'dept'"):
        named("dept")


def make_batch(size: int = 2, height: int = 16, width: int = 24) -> tuple[Batch, dict[str, Maps]]:
    """A batch with both tasks' targets, and maps of the network; leaves require gradients."""
    torch.manual_seed(3)
    image, offset = torch.rand(size, 3, height, width), torch.randn(size, 2, height, width)
    context = torch.rand(size, 2, 3, height, width)
    ones = torch.ones(size, 1, height, width)
    K_B33 = torch.tensor([[20.0, 0, 11.5], [0, 20, 7.5], [0, 0, 1]]).repeat(size, 1, 1)
    batch = Batch(
        names=["x"] * size,
        image_B3HW=image,
        camera=Camera(K_B33, torch.full((size,), 1.2), torch.zeros(size)),
        fields={
            "neighbours": context,
            "clean": image,
            "clean_neighbours": context,
            "reprojection_mask": ones[:, 0] > 0,
            "semantic": torch.randint(0, 20, (size, height, width)),
            "semantic_weight": ones[:, 0],
            "center": torch.rand_like(ones),
            "center_weight": ones,
            "offset": offset,
            "offset_weight": ones,
        },
    )
    panoptic = {
        "semantic": torch.randn(size, 20, height, width, requires_grad=True),
        "center": torch.rand_like(ones).requires_grad_(),
        "offset": torch.randn_like(offset).requires_grad_(),
    }
    depth = {
        name: (0.2 + torch.rand_like(ones)).requires_grad_()
        for name in ("inverse", "inverse.1", "inverse.2")
    }
    motion = torch.tensor([[0, 0, 0.05, 0, 0, 0], [0, 0, -0.05, 0, 0, 0]])
    transforms = geometry.pose_from_vector(motion).repeat(size, 1, 1, 1).requires_grad_()
    return batch, {"panoptic": panoptic, "depth": depth | {"transforms": transforms}}


def loss_terms(
    batch: Batch,
    maps: dict[str, Maps],
    tasks: tuple[str, ...] = TASKS,
    loss: config.Loss | None = None,
) -> dict[str, Tensor]:
    return Model(nn.Identity(), named(*tasks, loss=loss)).losses(Outputs(maps), batch)


def leaves(maps: dict[str, Maps]) -> dict[str, list[Tensor]]:
    """What each term must reach, and nothing else."""
    inverse = [maps["depth"][name] for name in ("inverse", "inverse.1", "inverse.2")]
    return {
        **{name: [map_] for name, map_ in maps["panoptic"].items()},
        "photometric": [*inverse, maps["depth"]["transforms"]],
        "smoothness": inverse,
    }


@pytest.mark.parametrize("tasks", [TASKS, ("panoptic",), ("depth",)])
def test_loss_terms_of_each_task_set(tasks: tuple[str, ...]) -> None:
    batch, maps = make_batch()
    losses = loss_terms(batch, maps, tasks)
    assert list(losses) == [term.name for term in terms_of(named(*tasks))]
    for name, loss in losses.items():
        assert loss.shape == ()
        assert loss.dtype == torch.float32
        assert loss.item() > 0
        wanted = leaves(maps)[name]
        for grad in torch.autograd.grad(loss, wanted, retain_graph=True):
            assert grad.isfinite().all()
            assert grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("empty", "left"),
    [
        ("offset_weight", {"semantic", "center", "photometric", "smoothness"}),  # no instance
        ("center_weight", {"semantic", "offset", "photometric", "smoothness"}),
        ("semantic_weight", {"center", "offset", "photometric", "smoothness"}),
        ("reprojection_mask", {"semantic", "center", "offset"}),
    ],
)
def test_terms_without_pixels_are_absent(empty: str, left: set[str]) -> None:
    batch, maps = make_batch()
    batch.fields[empty] = torch.zeros_like(batch.fields[empty])
    assert set(loss_terms(batch, maps)) == left


def test_depth_without_a_pixel_in_view_is_not_left_to_its_smoothness() -> None:
    batch, maps = make_batch()
    maps["depth"]["transforms"] = maps["depth"]["transforms"].detach().clone()
    maps["depth"]["transforms"][..., 0, 3] = 1e4
    assert set(loss_terms(batch, maps)) == {"semantic", "center", "offset"}
