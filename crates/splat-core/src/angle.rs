//! Angles for the fisheye projection, shared by all backends: an arc tangent that every device
//! computes alike, and h(t) = t / sin(t) with its slopes.

/// Numerator, from degree 4 down, of the rational function R(z) with
/// `atan(x) = x + x z R(z)`, z = x^2, on `|x| <= ATAN_REDUCED`; relative error 2e-16 (Moshier,
/// *Methods and Programs for Mathematical Functions*, 1989).
pub const ATAN_ABOVE: [f64; 5] = [
    -0.875_060_860_003_190_4,
    -16.157_537_187_333_652,
    -75.008_557_923_147_05,
    -122.886_668_449_013_61,
    -64.850_219_049_420_25,
];

/// Denominator of the same, from degree 5 down.
pub const ATAN_BELOW: [f64; 6] = [
    1.0,
    24.858_464_901_423_062,
    165.027_009_831_698_86,
    432.881_060_491_290_3,
    485.390_399_635_913_7,
    194.550_657_148_261_4,
];

/// Above this, `atan(x) = pi/4 + atan((x - 1) / (x + 1))`.
pub const ATAN_REDUCED: f64 = 0.66;

/// Square of the angle up to which h's slopes are series; beyond, their closed forms lose nothing.
pub const SERIES_END: f64 = 1.0;

/// Taylor coefficients of h'(t) / t in powers of t^2, constant first. The radius of convergence is
/// pi^2; the first [`SINGLE`] are enough for single precision.
pub const SLOPE: [f64; 20] = [
    0.333_333_333_333_333_3,
    0.077_777_777_777_777_78,
    0.012_301_587_301_587_301,
    0.001_679_894_179_894_18,
    0.000_213_360_456_416_011_98,
    2.596_016_931_334_391_6e-5,
    3.069_257_988_239_47e-6,
    3.554_228_936_627_266e-7,
    4.051_381_463_202_216e-8,
    4.561_021_541_443_643e-9,
    5.083_412_747_819_333e-10,
    5.618_808_966_943_667e-11,
    6.167_464_340_255_984e-12,
    6.729_636_243_186_46e-13,
    7.305_586_195_147_296e-14,
    7.895_580_170_778_398e-15,
    8.499_888_741_225_558e-16,
    9.118_787_168_400_893e-17,
    9.752_555_487_003_029e-18,
    1.040_147_858_403_598_8e-18,
];

/// Taylor coefficients of (h'(t) / t)' / t.
pub const CURVATURE: [f64; 20] = [
    0.155_555_555_555_555_56,
    0.049_206_349_206_349_205,
    0.010_079_365_079_365_079,
    0.001_706_883_651_328_095_8,
    0.000_259_601_693_133_439_2,
    3.683_109_585_887_363_4e-5,
    4.975_920_511_278_173e-6,
    6.482_210_341_123_545e-7,
    8.209_838_774_598_556e-8,
    1.016_682_549_563_866_5e-8,
    1.236_137_972_727_606_9e-9,
    1.480_191_441_661_436_1e-10,
    1.749_705_423_228_479_8e-11,
    2.045_564_134_641_242_8e-12,
    2.368_674_051_233_519_3e-13,
    2.719_964_397_192_178_4e-14,
    3.100_387_637_256_304e-15,
    3.510_919_975_321_091e-16,
    3.952_561_861_933_676e-17,
    4.426_338_511_415_825_5e-18,
];

/// Terms of the series that single precision needs.
pub const SINGLE: usize = 11;
