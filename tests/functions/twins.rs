//! Our twins of the functions in `functions.py`, and wrong ones.

use burn::tensor::{Int, Tensor};
use splat_model::losses::{self, SsimSettings};
use splat_ops::{
    ClampGradient, OpError, Photometric, ShColorSettings, SsimArgs, photometric,
    photometric_masked, sh_colors, ssim_map,
};

use super::fixture::{Leaves, Twin};

type Outputs = Result<Vec<Tensor<1>>, OpError>;

/// By file.
pub const TWINS: &[(&str, Twin)] = &[
    ("l1", |at| one(Ok(losses::l1(image(at), target(at))))),
    ("mse", |at| one(Ok(losses::mse(image(at), target(at))))),
    ("psnr", psnr),
    ("psnr_at_the_ends", psnr),
    ("ssim", ssim),
    ("ssim_smaller_than_window", ssim),
    ("ssim_as_large_as_window", ssim),
    ("ssim_patches", ssim),
    ("ssim_map", map),
    ("ssim_map_one_row", map),
    ("ssim_map_flat", map),
    ("ssim_map_identical", map),
    ("ssim_map_black", map),
    ("photometric", both),
    ("photometric_levels", |at| of_levels(at, 1.0)),
    ("photometric_smaller_than_window", both),
    ("photometric_3dgs", |at| one(Ok(weighted(&measured(at)?)))),
    ("photometric_masked", both_masked),
    ("photometric_masked_half", both_masked),
    ("photometric_masked_nothing_kept", both_masked),
    ("sh_colors_0", colors),
    ("sh_colors_1", colors),
    ("sh_colors_1_of_three", colors),
    ("sh_colors_2", colors),
    ("sh_colors_3", colors),
    ("sh_colors_near_centre", colors),
];

/// A file, the tensor that must fail, and a function that is wrong.
pub const BUGS: &[(&str, &str, Twin)] = &[
    // The gradient of the target is missing.
    ("l1", "grad.target", |at| {
        one(Ok(losses::l1(image(at), target(at).detach())))
    }),
    // Half of it, as if the error were not squared.
    ("psnr", "output", |at| {
        one(Ok(losses::psnr(image(at), target(at)) * 0.5))
    }),
    // Nothing is clamped.
    ("psnr", "grad.image", |at| {
        let mse = losses::mse(image(at), target(at));
        one(Ok(mse.log() * (-10.0 / core::f64::consts::LN_10)))
    }),
    // Another window.
    ("ssim", "output", |at| {
        let settings = SsimSettings::new().with_sigma(1.501);
        one(losses::ssim(image(at), target(at), &settings))
    }),
    // The mean over all pixels.
    ("ssim", "grad.image", |at| {
        one(Ok(ssim_map(image(at), target(at), &args())?.mean()))
    }),
    // Only one of the images is differentiated.
    ("ssim_map", "grad.y", |at| {
        one(Ok(flat(ssim_map(
            at.get("x"),
            at.get::<4>("y").detach(),
            &args(),
        )?)))
    }),
    // No constant in the contrast, as good as.
    ("ssim_map_flat", "output", |at| {
        let args = SsimSettings::new().with_k2(0.028).args();
        one(Ok(flat(ssim_map(at.get("x"), at.get("y"), &args)?)))
    }),
    // Levels of a 256th.
    ("photometric_levels", "output", |at| {
        of_levels(at, 255.0 / 256.0)
    }),
    // The difference is the mean over all pixels.
    ("photometric_masked", "output", |at| {
        let mask = at.get::<4>("mask");
        let seen = at.get::<4>("rendered") * mask.clone().repeat_dim(3, 4);
        let target = target(at) * mask.repeat_dim(3, 3);
        one(Ok(photometric(seen, target, &args())?.losses()))
    }),
    // The similarity is that of everything.
    ("photometric_masked_half", "grad.rendered", |at| {
        let all = measured(at)?.losses().narrow(0, 1, 1);
        one(Ok(Tensor::cat(vec![masked(at)?.l1(), all], 0)))
    }),
    // The direction is detached.
    ("sh_colors_3", "grad.means", |at| {
        shaded(at, at.get::<2>("means").detach(), 3)
    }),
    // A band is missing.
    ("sh_colors_3", "colors", |at| shaded(at, at.get("means"), 2)),
    // What is clamped may recover.
    ("sh_colors_0", "grad.sh0", recovering),
    ("sh_colors_3", "grad.sh_rest", recovering),
];

fn one(output: Result<Tensor<1>, OpError>) -> Outputs {
    Ok(vec![output?])
}

fn flat<const D: usize>(tensor: Tensor<D>) -> Tensor<1> {
    let count = tensor.dims().iter().product::<usize>();
    tensor.reshape([count])
}

fn image(at: &Leaves) -> Tensor<4> {
    at.get("image")
}

fn target(at: &Leaves) -> Tensor<4> {
    at.get("target")
}

fn args() -> SsimArgs {
    SsimSettings::default().args()
}

fn psnr(at: &Leaves) -> Outputs {
    one(Ok(losses::psnr(image(at), target(at))))
}

fn ssim(at: &Leaves) -> Outputs {
    one(losses::ssim(
        image(at),
        target(at),
        &SsimSettings::default(),
    ))
}

fn map(at: &Leaves) -> Outputs {
    one(Ok(flat(ssim_map(at.get("x"), at.get("y"), &args())?)))
}

fn measured(at: &Leaves) -> Result<Photometric, OpError> {
    photometric(at.get("rendered"), target(at), &args())
}

fn both(at: &Leaves) -> Outputs {
    one(Ok(measured(at)?.losses()))
}

fn both_masked(at: &Leaves) -> Outputs {
    one(Ok(masked(at)?.losses()))
}

/// Losses against bytes; where they are scaled, against values.
fn of_levels(at: &Leaves, scale: f64) -> Outputs {
    let rendered = at.get("rendered");
    let measured = if scale == 1.0 {
        let levels: Tensor<4, Int> = target(at).int();
        photometric(rendered, levels, &args())
    } else {
        photometric(rendered, target(at) * (scale / 255.0), &args())
    };
    one(Ok(measured?.losses()))
}

fn masked(at: &Leaves) -> Result<Photometric, OpError> {
    photometric_masked(at.get("rendered"), target(at), at.get("mask"), &args())
}

fn weighted(measured: &Photometric) -> Tensor<1> {
    measured.l1() * 0.8 + (-measured.ssim() + 1.0) * 0.2
}

fn colors(at: &Leaves) -> Outputs {
    shaded(at, at.get("means"), at.number("degree"))
}

fn recovering(at: &Leaves) -> Outputs {
    let settings = ShColorSettings {
        degree: at.number("degree"),
        clamp_gradient: ClampGradient::Recovering,
    };
    shaded(at, at.get("means"), settings)
}

fn shaded(at: &Leaves, means: Tensor<2>, settings: impl Into<ShColorSettings>) -> Outputs {
    let rest = at.has("sh_rest").then(|| at.get("sh_rest"));
    let colors = sh_colors(
        at.get("sh0"),
        rest,
        means,
        at.get("centers"),
        settings,
        None,
    )?;
    one(Ok(flat(colors)))
}
