//! Instruction sets are chosen for the whole process, so no other test may run beside this one.

use burn::tensor::{Device, Distribution, Tensor, TensorData};
use splat_ops::cpu::InstructionSet;
use splat_ops::{ImageSize, Projected, RasterizeSettings, rasterize};

const SIZE: ImageSize = ImageSize {
    width: 45,
    height: 33,
};
const SPLATS: usize = 300;

/// Image of some splats, and the gradient of the packed splats.
fn rendered(packed: &TensorData, colors: &TensorData) -> [Vec<f32>; 2] {
    let device = Device::flex().autodiff();
    let packed = Tensor::<3>::from_data(packed.clone(), &device).require_grad();
    let projected = Projected::from_packed(packed.clone(), SIZE).unwrap();
    let colors = Tensor::<2>::from_data(colors.clone(), &device);
    let opacities = Tensor::<1>::full([SPLATS], 0.3, &device);
    let settings = RasterizeSettings::default();
    let rendered = rasterize(&projected, colors, opacities, None, &settings).unwrap();
    let image = rendered.image();
    let grads = image.clone().square().sum().backward();
    let grad = packed.grad(&grads).unwrap().into_data();
    [image.into_data(), grad].map(|data| data.try_into_vec::<f32>().unwrap())
}

#[test]
fn every_set_that_is_available_can_be_chosen_and_renders_the_same() {
    let device = Device::flex();
    let random = |low, high| {
        Tensor::<1>::random([SPLATS], Distribution::Uniform(low, high), &device).into_data()
    };
    let columns = [
        random(0.0, 45.0),
        random(0.0, 33.0),
        random(1.0, 2.0),
        random(0.1, 0.5),
        random(-0.2, 0.2),
        random(0.1, 0.5),
        random(1.0, 1.0 + 1e-6),
        random(40.0, 41.0),
        random(40.0, 41.0),
    ];
    let columns = columns.map(|column| column.try_into_vec::<f32>().unwrap());
    let rows = (0..SPLATS).flat_map(|n| columns.each_ref().map(|column| column[n]));
    let packed = TensorData::new(rows.collect::<Vec<_>>(), [1, SPLATS, 9]);
    let colors = Tensor::<2>::random([SPLATS, 3], Distribution::Default, &device).into_data();

    let best = InstructionSet::chosen();
    assert_eq!(InstructionSet::available()[0], best);
    let first = rendered(&packed, &colors);
    for set in InstructionSet::available() {
        let (chosen, again) =
            set.at_most(|| (InstructionSet::chosen(), rendered(&packed, &colors)));
        assert_eq!(chosen, set);
        for (ours, theirs) in again.iter().zip(&first) {
            let norm = |values: &mut dyn Iterator<Item = f32>| {
                values
                    .map(|value| f64::from(value).powi(2))
                    .sum::<f64>()
                    .sqrt()
            };
            let error = norm(&mut ours.iter().zip(theirs).map(|(a, b)| a - b));
            let size = norm(&mut theirs.iter().copied());
            assert!(
                size > 1.0 && error < 1e-5 * size,
                "{set}: {error:e} of {size:e}"
            );
        }
    }
    assert_eq!(InstructionSet::chosen(), best);
    assert_eq!(rendered(&packed, &colors), first);
}
