//! Structural similarity.

use burn::backend::Backend;
use burn::backend::tensor::FloatTensor;

use crate::backend::{BlurOps, SsimGradients, SsimTensors};
use crate::settings::SsimArgs;

/// A, B, C, D of the structural similarity `A C / (B D)`, from the four windowed means.
fn ssim_terms<B: Backend>(moments: &[FloatTensor<B>], args: &SsimArgs) -> [FloatTensor<B>; 4] {
    let [mx, my, q, p] = [0, 1, 2, 3].map(|i| moments[i].clone());
    let product = B::float_mul(mx.clone(), my.clone());
    let squares = B::float_add(B::float_mul(mx.clone(), mx), B::float_mul(my.clone(), my));
    let twice_and = |v, constant: f64| {
        let twice = B::float_mul_scalar(v, 2.0.into());
        B::float_add_scalar(twice, constant.into())
    };
    [
        twice_and(product.clone(), args.c1),
        B::float_add_scalar(squares.clone(), args.c1.into()),
        twice_and(B::float_sub(p, product), args.c2),
        B::float_add_scalar(B::float_sub(q, squares), args.c2.into()),
    ]
}

/// [`ssim_map`](crate::ssim_map), and the windowed means of x, y, x^2 + y^2 and xy.
pub(crate) fn ssim_forward<B: BlurOps>(
    SsimTensors { x, y }: SsimTensors<FloatTensor<B>>,
    args: &SsimArgs,
) -> (FloatTensor<B>, Vec<FloatTensor<B>>) {
    let square = |v: &FloatTensor<B>| B::float_mul(v.clone(), v.clone());
    let squares = B::float_add(square(&x), square(&y));
    let product = B::float_mul(x.clone(), y.clone());
    let moments: Vec<_> = [x, y, squares, product]
        .into_iter()
        .map(|image| B::gaussian_blur(image, args.window.clone()))
        .collect();
    let [a, b, c, d] = ssim_terms::<B>(&moments, args);
    (
        B::float_div(B::float_mul(a, c), B::float_mul(b, d)),
        moments,
    )
}

/// The gradients of [`ssim_forward`]; see the formulas in `cpu/photometric/sweep.rs`.
pub(crate) fn ssim_backward<B: BlurOps>(
    SsimTensors { x, y }: SsimTensors<FloatTensor<B>>,
    moments: &[FloatTensor<B>],
    grad: FloatTensor<B>,
    args: &SsimArgs,
    needs_grad: SsimTensors<bool>,
) -> SsimGradients<B> {
    let [a, b, c, d] = ssim_terms::<B>(moments, args);
    let mul = |l: &FloatTensor<B>, r: &FloatTensor<B>| B::float_mul(l.clone(), r.clone());
    let div = |l: &FloatTensor<B>, r: &FloatTensor<B>| B::float_div(l.clone(), r.clone());
    let twice = |v: FloatTensor<B>| B::float_mul_scalar(v, 2.0.into());
    let blur = |v: FloatTensor<B>| B::gaussian_blur(v, args.window.clone());

    let scaled = div(&grad, &mul(&b, &d));
    let weighted = mul(&scaled, &mul(&a, &c));
    let slope = B::float_sub(div(&weighted, &d), div(&weighted, &b));
    let contrast = mul(&scaled, &B::float_sub(c, a.clone()));
    let by_squares = twice(blur(B::float_neg(div(&weighted, &d))));
    let by_product = blur(twice(mul(&scaled, &a)));
    let gradient = |own: &FloatTensor<B>, other: &FloatTensor<B>, mine: usize| {
        let theirs = 1 - mine;
        let by_mean = blur(twice(B::float_add(
            mul(&moments[theirs], &contrast),
            mul(&moments[mine], &slope),
        )));
        let rest = B::float_add(mul(own, &by_squares), mul(other, &by_product));
        B::float_add(by_mean, rest)
    };
    SsimTensors {
        x: needs_grad.x.then(|| gradient(&x, &y, 0)),
        y: needs_grad.y.then(|| gradient(&y, &x, 1)),
    }
}
