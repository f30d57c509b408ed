//! Colours from half-precision coefficients equal those from the same coefficients in single
//! precision, and those of Gaussians of different degrees equal those with zeros in place, bit for
//! bit.

use cubecl::client::Client;
use rand_pcg::Pcg32;
use splat_core::ShColorTensors;
use splat_kernels::sh_colors::{ShColorInputs, ShRest, sh_colors, sh_colors_backward};
use splat_kernels::{Buffer, HalfBuffer, reads_half};

use crate::device::{client, rng, uniform, upload};

/// The float value of a half.
fn single(half: u16) -> f32 {
    let (exponent, fraction) = (i32::from(half >> 10 & 31), f32::from(half & 1023));
    let magnitude = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1024.0 + fraction) * 2f32.powi(exponent - 25),
    };
    if half >> 15 == 1 {
        -magnitude
    } else {
        magnitude
    }
}

/// Gaussians with 15 coefficients each, the values, and random colours, means and centres.
fn inputs(client: &Client, rng: &mut Pcg32, rest: &[f32], cameras: usize) -> ShColorInputs {
    let n = rest.len() / 45;
    let mut random = |rows: usize| upload(client, &uniform(rng, rows * 3, -1.0, 1.0));
    ShColorInputs {
        sh0: random(n),
        sh_rest: Some(ShRest::Exact(upload(client, rest))),
        stored: 15,
        starts: None,
        means: random(n),
        centers: random(cameras),
        seen: None,
    }
}

/// Colours, and the gradients of sh0, means and centres, as bits.
fn bits(client: &Client, inputs: &ShColorInputs, grad: &Buffer, degree: usize) -> Vec<Vec<u32>> {
    let read = |buffer: &Buffer| -> Vec<u32> {
        let values = buffer.read_f32(client).unwrap();
        values.iter().map(|value| value.to_bits()).collect()
    };
    let wanted = ShColorTensors {
        sh0: true,
        means: true,
        centers: true,
        ..Default::default()
    };
    let grads: [_; 5] = sh_colors_backward(client, inputs, grad, degree.into(), wanted).into();
    let mut found = vec![read(&sh_colors(client, inputs, degree.into()))];
    found.extend(grads.iter().flatten().map(read));
    assert_eq!(found.len(), 4);
    found
}

#[test]
fn halves_are_read_as_the_numbers_they_stand_for() {
    let Some(client) = client() else { return };
    if !reads_half(&client) {
        eprintln!("\n*** SKIPPED: this device reads no half precision ***\n");
        return;
    }
    let mut rng = rng(37);
    // An odd number of halves: the last is half of a word.
    let (n, cameras) = (701, 2);
    let mut halves: Vec<u16> = uniform(&mut rng, n * 45, 0.0, 65_536.0)
        .iter()
        .map(|half| *half as u16)
        .map(|half| {
            if half >> 10 & 31 > 16 {
                half & 0xbfff
            } else {
                half
            }
        })
        .collect();
    // Zeros, the smallest and largest subnormal, the smallest and largest normal, infinity.
    let odd = [0, 0x8000, 1, 0x8001, 0x03ff, 0x0400, 0x7bff, 0x7c00];
    halves[..odd.len()].copy_from_slice(&odd);
    let values: Vec<f32> = halves.iter().map(|half| single(*half)).collect();
    assert_eq!(
        values[2..7],
        [
            5.960_464_5e-8,
            -5.960_464_5e-8,
            6.097_555e-5,
            6.103_515_6e-5,
            65_504.0
        ]
    );

    let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
    let handle = client.create_from_slice(&bytes);
    assert!(HalfBuffer::new(handle.clone(), halves.len() + 1).is_err());
    let exact = inputs(&client, &mut rng, &values, cameras);
    let half = ShColorInputs {
        sh_rest: Some(ShRest::Half(HalfBuffer::new(handle, halves.len()).unwrap())),
        ..exact.clone()
    };
    let grad = upload(&client, &uniform(&mut rng, cameras * n * 3, -1.0, 1.0));
    for degree in 1..=3 {
        let [found, expected] = [&half, &exact].map(|inputs| bits(&client, inputs, &grad, degree));
        assert!(found == expected, "degree {degree}");
        let colors = found[0].iter().filter(|color| **color != 0);
        assert!(
            colors.count() > n,
            "degree {degree}: too few colours to compare"
        );
    }
}

#[test]
fn gaussians_of_different_degrees_are_as_with_zeros_in_place() {
    let Some(client) = client() else { return };
    let mut rng = rng(38);
    let (n, cameras) = (701, 2);
    // Halves, so that they are the same numbers in either precision.
    let halves: Vec<u16> = (0..n * 45)
        .map(|i| 0x3400 + (i * 37 % 1024) as u16)
        .collect();
    let mut values: Vec<f32> = halves.iter().map(|half| single(*half)).collect();
    let (mut starts, mut own, mut own_halves) = (vec![0], Vec::new(), Vec::new());
    for i in 0..n {
        let count = [15, 0, 3, 8, 0][i % 5];
        let (of_gaussian, kept) = (45 * i, 3 * count);
        own.extend_from_slice(&values[of_gaussian..][..kept]);
        own_halves.extend_from_slice(&halves[of_gaussian..][..kept]);
        values[of_gaussian + kept..of_gaussian + 45].fill(0.0);
        starts.push((own.len() / 3) as u32);
    }
    let uniform_inputs = inputs(&client, &mut rng, &values, cameras);
    let ragged = ShColorInputs {
        sh_rest: Some(ShRest::Exact(upload(&client, &own))),
        stored: 1,
        starts: Some(Buffer::from_u32(&client, &starts)),
        ..uniform_inputs.clone()
    };
    let mut all = vec![&ragged];
    let half = reads_half(&client).then(|| {
        let bytes: Vec<u8> = own_halves
            .iter()
            .flat_map(|half| half.to_le_bytes())
            .collect();
        let handle = client.create_from_slice(&bytes);
        ShColorInputs {
            sh_rest: Some(ShRest::Half(HalfBuffer::new(handle, own.len()).unwrap())),
            ..ragged.clone()
        }
    });
    all.extend(&half);
    let grad = upload(&client, &uniform(&mut rng, cameras * n * 3, -1.0, 1.0));
    let rest_only = ShColorTensors {
        sh_rest: true,
        ..Default::default()
    };
    for degree in 1..=3 {
        let expected = bits(&client, &uniform_inputs, &grad, degree);
        for inputs in &all {
            assert!(
                bits(&client, inputs, &grad, degree) == expected,
                "degree {degree}"
            );
        }
        let of_rest = |inputs: &ShColorInputs| {
            let grads = sh_colors_backward(&client, inputs, &grad, degree.into(), rest_only);
            grads.sh_rest.unwrap().read_f32(&client).unwrap()
        };
        let (found, padded) = (of_rest(&ragged), of_rest(&uniform_inputs));
        assert_eq!(found.len(), own.len());
        for (i, pair) in starts.windows(2).enumerate() {
            let found = &found[3 * pair[0] as usize..3 * pair[1] as usize];
            assert!(
                found == &padded[45 * i..][..found.len()],
                "degree {degree}: {i}"
            );
        }
    }
}
