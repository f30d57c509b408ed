//! Complete checks, on fixtures made here.

use burn::tensor::Device;

use super::*;
use crate::accuracy::Sketch;

/// Degree 1 uses the first four rows: a file may contain no more, or further ones that nothing
/// reads.
#[test]
fn any_number_of_coefficients_is_checked() {
    let mut sketch = Sketch::new("rows", 16, 16, 3);
    sketch.scatter(5, (0.2, 0.8));
    let scene = sketch.scene();
    for rows in [4, 7, 16] {
        let mut scene = scene.clone();
        let coefficients = &mut scene.inputs.sh_coeffs;
        let kept = coefficients.values.chunks_exact(48);
        let kept = kept.flat_map(|gaussian| gaussian[..3 * rows].to_vec());
        coefficients.values = kept.collect();
        coefficients.shape[1] = rows;
        let reference = run(&scene, &Device::flex(), Precision::F64, None).unwrap();
        let mut fixture = Fixture {
            case: String::new(),
            hard: false,
            scene,
            expected: reference.outputs,
            gradients: reference.gradients,
            absgrad: reference.absgrad,
        };
        for precision in [Precision::F64, Precision::F32] {
            let report = check(&fixture, &Device::flex(), precision, None).unwrap();
            assert!(report.pass, "{rows} rows: {report:#?}");
        }
        fixture.gradients.sh_coeffs.values[3 * rows + 4] *= 1.01;
        let report = check(&fixture, &Device::flex(), Precision::F32, None).unwrap();
        assert_eq!(report.failed(), ["sh_rest"], "{rows} rows");
    }
}
