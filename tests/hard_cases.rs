//! The 38 hard cases, each a named test, on the CPU and on the CubeCL kernels in single precision.
#![cfg(feature = "cpu")]

#[cfg(feature = "wgpu")]
mod adapter;

#[cfg(feature = "wgpu")]
use adapter::adapter;
use burn::tensor::Device;
use splat_lab::accuracy::{Case, cases};

fn case(number: u8) -> Case {
    let cases = cases();
    let found: Vec<_> = cases.iter().filter(|case| case.number == number).collect();
    assert_eq!(found.len(), 1, "case {number}");
    *found[0]
}

fn check(number: u8, backend: &str, device: &Device) {
    let case = case(number);
    let outcome = case
        .measure(device)
        .unwrap_or_else(|error| panic!("case {number} on {backend}: {error}"));
    println!(
        "case {number:>2} on {backend:<4} forward {:.1e}  gradient {:.1e} ({})  {}  {}",
        outcome.forward, outcome.gradient, outcome.worst_group, case.name, outcome.detail
    );
    assert!(
        outcome.holds,
        "case {number} ({}) on {backend}: forward {:.2e}, gradient {:.2e} ({}), {}",
        case.name, outcome.forward, outcome.gradient, outcome.worst_group, outcome.detail
    );
}

#[test]
fn every_number_is_there_once() {
    let numbers: Vec<u8> = cases().iter().map(|case| case.number).collect();
    assert_eq!(numbers, (1..=44).collect::<Vec<u8>>());
}

macro_rules! hard_cases {
    ($($name:ident: $number:literal),* $(,)?) => {
        mod cpu {
            $(#[test] fn $name() { super::check($number, "cpu", &super::Device::flex()); })*
        }
        #[cfg(feature = "wgpu")]
        mod wgpu {
            $(#[test] fn $name() {
                if let Some(device) = super::adapter() {
                    super::check($number, "wgpu", &device);
                }
            })*
        }
    };
}

hard_cases! {
    case_01_faint_layers: 1,
    case_02_opaque_first: 2,
    case_03_cap_above_stop: 3,
    case_04_opacity_logits: 4,
    case_05_exactly_at_cap: 5,
    case_06_exactly_at_cut: 6,
    case_07_needles_1000: 7,
    case_08_needles_10000: 8,
    case_09_pancake_edge_on: 9,
    case_10_sub_pixel_antialiased: 10,
    case_11_extreme_scales: 11,
    case_12_extreme_quaternions: 12,
    case_13_quaternion_multiples: 13,
    case_14_equal_scales: 14,
    case_15_at_camera_centre: 15,
    case_16_near_plane: 16,
    case_17_at_the_clamp: 17,
    case_18_off_centre: 18,
    case_19_needle_outside: 19,
    case_20_wide_field_of_view: 20,
    case_21_covers_the_image: 21,
    case_22_on_centres_and_edges: 22,
    case_23_odd_sizes: 23,
    case_24_equal_depths: 24,
    case_25_depths_an_ulp_apart: 25,
    case_26_map_coordinates: 26,
    case_27_other_units: 27,
    case_28_colour_crosses_zero: 28,
    case_29_direction_gradient: 29,
    case_30_nothing_visible: 30,
    case_31_poisoned: 31,
    case_32_too_many_pairs: 32,
    case_33_all_losses: 33,
    case_34_million_contributions: 34,
    case_35_ssim_patches: 35,
    case_36_adam_spike: 36,
    case_37_large_sh_eight_bit: 37,
    case_38_relocation: 38,
    case_39_on_the_axis: 39,
    case_40_strong_distortion: 40,
    case_41_near_the_fold: 41,
    case_42_off_the_axis: 42,
    case_43_needle_at_the_edge: 43,
    case_44_antialiased_fold: 44,
}

/// Needles up to 10,000 : 1: the determinant is accurate to 1e-3 and the exponent to 1e-2, and
/// nothing visible is culled.
fn check_projection(backend: &str, device: &Device) {
    let errors = splat_lab::accuracy::projection::projection_errors(1_000_000, 1, device)
        .unwrap_or_else(|error| panic!("{backend}: {error}"));
    println!("{backend}: {errors:?}");
    assert!(errors.visible > 500_000, "{errors:?}");
    assert_eq!(errors.culled_but_visible, 0, "{errors:?}");
    assert!(errors.determinant <= 1e-3, "{errors:?}");
    assert!(errors.exponent <= 1e-2, "{errors:?}");
}

#[test]
fn a_million_extreme_gaussians_on_cpu() {
    check_projection("cpu", &Device::flex());
}

#[cfg(feature = "wgpu")]
#[test]
fn a_million_extreme_gaussians_on_wgpu() {
    if let Some(device) = adapter() {
        check_projection("wgpu", &device);
    }
}
