"""Every size, rate and weight of reconstruction; the profiles in data_specs/profiles give them values."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

PositiveInt = Annotated[int, Field(gt=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
Weight = Annotated[float, Field(ge=0)]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ModelSettings(_Settings):
    """Sizes of latents, decoder, fields and image network."""

    decoder: bool = Field(
        default=True,
        description="whether planes are decoded from latent codes; else every actor's planes are learned themselves",
    )
    latent_size: PositiveInt = 8
    latent_channels: PositiveInt = 32
    decoder_channels: tuple[PositiveInt, ...] = (64, 48, 32, 16)
    decoder_groups: PositiveInt = Field(default=32, description="groups of group normalisation, at most")
    decoder_patch_channels: Annotated[int, Field(ge=0)] = Field(
        default=128, description="width of the decoder's shallow path from code to plane; 0 leaves it out"
    )
    plane_channels: PositiveInt = 8
    field_hidden: PositiveInt = 48
    sharpness: PositiveFloat = Field(default=20.0, description="beta at the start, in 1/m")
    features: PositiveInt = 16
    shadow_hidden: Annotated[int, Field(ge=0)] = Field(
        default=0, description="width of the network that says how actors shade the ground; 0 leaves it out"
    )
    background_resolution: PositiveInt = 192
    background_plane_channels: PositiveInt = 8
    background_hidden: PositiveInt = 32
    background_radius: PositiveFloat = 60.0
    background_height: PositiveFloat = 15.0
    rgb_channels: PositiveInt = 24
    rgb_kernel: PositiveInt = 3
    rgb_blocks: PositiveInt = 3
    rgb_upsamplings: Annotated[int, Field(ge=0, le=2)] = 1
    coarse_resolution: PositiveInt = 32

    @model_validator(mode="after")
    def _blocks_fit(self) -> ModelSettings:
        if self.rgb_kernel % 2 == 0:
            raise ValueError(f"rgb_kernel is {self.rgb_kernel}: an odd number is needed")
        if self.rgb_blocks < 2 * self.rgb_upsamplings:
            raise ValueError(
                f"rgb_blocks is {self.rgb_blocks}: {self.rgb_upsamplings} upsamplings need twice as many blocks"
            )
        return self

    @property
    def plane_size(self) -> int:
        """Texels along a side of an actor's planes: every block of the decoder but the first doubles the latent."""
        return self.latent_size * 2 ** (len(self.decoder_channels) - 1)


class RenderingSettings(_Settings):
    """Sampling along rays. Lengths in metres."""

    actor_step: PositiveFloat = 0.10
    actor_growth: Weight = 0.005
    background_step: PositiveFloat = 1.0
    background_growth: Weight = 0.1
    background_near: PositiveFloat = 1.0
    background_far: PositiveFloat = 80.0
    sky_samples: Annotated[int, Field(ge=1)] = 8
    weight_threshold: Annotated[float, Field(ge=0, lt=1)] = 3e-3
    least_light: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.0,
        description="share of a ray's light at which it is followed no further, front to back; 0 follows all at once",
    )
    occupancy_cell: PositiveFloat = 0.5
    occupancy_dilation: Annotated[int, Field(ge=0)] = 1
    coarse_refresh: PositiveInt = Field(
        default=2, description="steps between refreshes of one actor's coarse distance"
    )


class LearningRates(_Settings):
    """Adam's rates at the start; all fall along a half cosine to `final` times their start."""

    latent: PositiveFloat = 0.1
    decoder: PositiveFloat = 4e-3
    discriminator: PositiveFloat = 1e-4
    field: PositiveFloat = 5e-3
    sharpness: PositiveFloat = 0.05
    background: PositiveFloat = 5e-2
    rgb: PositiveFloat = 2e-3
    final: Annotated[float, Field(gt=0, le=1)] = 0.05


class LossWeights(_Settings):
    """Weights of the objective (paper, "Training Details").

    Networks of the perceptual and the adversarial term are there only where the weight is not 0.
    """

    rgb: Weight = 1.0
    perceptual: Weight = 0.0
    adversarial: Weight = 0.0
    lidar: Weight = 0.01
    surface: Weight = 0.05
    carving: Weight = 0.0
    total_variation: Weight = 0.05
    kl: Weight = 1e-5


class ReconstructionSettings(_Settings):
    """One reconstruction: what is rendered, with which model, for how long."""

    image_scale: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.25, description="size of rendered images as a share of the log's images"
    )
    rolling_shutter: Weight = Field(
        default=0.0,
        description="seconds in which a camera reads its rows, from the upper edge to the lower, with its stamp in "
        "the middle; 0: all at once",
    )
    steps: PositiveInt = 1500
    views: PositiveInt = Field(
        default=2, description="views of a step; where there are cores, they are learned from side by side"
    )
    patches: PositiveInt = Field(default=8, description="patches of a view")
    decoded_actors: PositiveInt = Field(
        default=8,
        description="actors decoded and learned in a view; others that rays meet keep the planes they had",
    )
    patch_size: PositiveInt = Field(default=16, description="side of a training patch in feature pixels")
    patch_margin: Annotated[int, Field(ge=0)] = Field(
        default=2,
        description="feature pixels rendered around a patch as context for the image network. A trade-off: fewer "
        "than the network reaches, so that patches' edges are learned without all that a whole frame shows there, "
        "but every one more is rendered all around every patch",
    )
    background_share: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.15, description="share of patches placed anywhere in an image rather than on an actor"
    )
    object_patch_share: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.25,
        description="share of views that also render one actor's box, for the perceptual and the adversarial loss",
    )
    object_patch_limit: PositiveInt = Field(
        default=64,
        description="feature pixels along a side of such a box; of a larger one a window is rendered",
    )
    object_patch_size: Annotated[int, Field(ge=64)] = Field(
        default=64, description="pixels that its image is resized to before it is compared"
    )
    adversarial_start: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.5, description="share of the steps after which the adversarial loss sets in"
    )
    mirror_share: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="chance that a vehicle is learned left for right in a view"
    )
    lidar_rays: Annotated[int, Field(ge=0)] = Field(default=128, description="LiDAR rays of a view")
    lidar_trim: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.05, description="share of the largest LiDAR residuals left out of a batch"
    )
    surface_samples: Annotated[int, Field(ge=0)] = Field(
        default=64,
        description="LiDAR returns, and points of free space before them, a learned actor and view",
    )
    smallest_actor: PositiveInt = Field(
        default=8,
        description="pixels, in the rendered image, that the longer side of an actor's box must have to be learned",
    )
    checkpoint_every: PositiveInt = 200
    model: ModelSettings = ModelSettings()
    rendering: RenderingSettings = RenderingSettings()
    rates: LearningRates = LearningRates()
    weights: LossWeights = LossWeights()


class ComputeSettings(_Settings):
    """What a reconstruction is computed with."""

    processes: PositiveInt = Field(
        default=1, description="processes that share out the views of a step, each with the whole model"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto", description="where networks are; auto: a GPU where torch finds one"
    )
    precision: Literal["32-true", "bf16-mixed"] = Field(
        default="32-true", description="bf16-mixed: networks compute in bfloat16, on a GPU alone"
    )


class AdaptationSettings(_Settings):
    """Learning a log's codes and background for a library that is there already, and nothing else."""

    library: Annotated[str, Field(min_length=1)] = Field(
        description="the asset library: a directory, the id of a run, or the name of an experiment, whose newest "
        "run that made one is taken"
    )
    start: Literal["random", "class_mean", "nearest"] = Field(
        default="class_mean",
        description="code that an actor begins with: a random one, the mean of the library's actors of its class, or "
        "that of the library's actor of its class that is nearest in size and colour",
    )
    extend: bool = Field(
        default=False,
        description="the result holds the library's actors and logs, as they are, and after them the new ones",
    )
    prior: Annotated[str, Field(min_length=1)] | None = Field(
        default=None,
        description="the prior that pulls at the codes, L_rend + prior_weight L_diff: a directory, a run or an "
        "experiment as for `library`, and learned from its codes; none: L_rend alone",
    )
    prior_weight: PositiveFloat = Field(default=1.0, description="lambda_diff, weight of the prior's loss")
    prior_reuse: PositiveInt = Field(
        default=4, description="steps of an actor that a gradient of the prior is used for"
    )
