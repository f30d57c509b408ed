//! Any Burn optimiser, with its state edited on the host.

use burn::optim::{LearningRate, Optimizer, RecordState, StateSink, StateSource};
use burn::tensor::{Device, Tensor, TensorData};

use super::edit::{MomentEdit, RowOptimizer};
use super::state_record::StateRecord;

/// Turns any Burn optimiser into a [`RowOptimizer`]. An edit reads the state back, edits every
/// tensor that has one row per parameter row, and uploads it again. That transfers twice the size
/// of the state per edit and waits for the device; at one edit per hundred steps, about 1 % of the
/// traffic of the steps. A state that cannot be reassembled restarts.
#[derive(Debug, Clone)]
pub struct ThroughHost<O>(pub O);

impl<O: Optimizer> Optimizer for ThroughHost<O> {
    type State<const D: usize> = HostState<O::State<D>>;

    fn step<const D: usize>(
        &self,
        rate: LearningRate,
        tensor: Tensor<D>,
        grad: Tensor<D>,
        state: Option<Self::State<D>>,
    ) -> (Tensor<D>, Option<Self::State<D>>) {
        let device = tensor.device();
        let state = state.and_then(|state| state.inner);
        let state = state.map(|state| O::to_device(state, &device));
        let rows = grad.dims()[0];
        let (tensor, state) = self.0.step(rate, tensor, grad, state);
        (tensor, Some(HostState { rows, inner: state }))
    }

    fn to_device<const D: usize>(state: Self::State<D>, device: &Device) -> Self::State<D> {
        HostState {
            inner: state.inner.map(|state| O::to_device(state, device)),
            ..state
        }
    }
}

/// A state, with the number of rows of its parameter.
#[derive(Debug, Clone)]
pub struct HostState<S> {
    rows: usize,
    inner: Option<S>,
}

impl<S: RecordState + Clone> RecordState for HostState<S> {
    fn state_flatten(&self, prefix: &str, out: &mut StateSink) {
        out.push_scalar(prefix, "rows", self.rows.into());
        if let Some(inner) = &self.inner {
            inner.state_flatten(&burn::optim::join_path(prefix, "inner"), out);
        }
    }

    fn state_unflatten(prefix: &str, src: &mut StateSource, device: &Device) -> Option<Self> {
        let rows = usize::try_from(src.take_scalar(prefix, "rows")?).ok()?;
        let inner = burn::optim::join_path(prefix, "inner");
        // An existing state must be one of this optimiser.
        let has_state = src.has_under(&inner);
        let inner = S::state_unflatten(&inner, src, device);
        (inner.is_some() || !has_state).then_some(Self { rows, inner })
    }
}

impl<O: Optimizer> RowOptimizer for ThroughHost<O> {
    /// The layout of a state is known only to the optimiser.
    fn check_state(_: &StateRecord, _: [usize; 2]) -> Result<(), String> {
        Ok(())
    }

    fn edit_rows(state: Self::State<2>, edit: &MomentEdit) -> Self::State<2> {
        let Some(inner) = state.inner else {
            return state;
        };
        let (rows, device) = match edit {
            MomentEdit::Gather { source, .. } | MomentEdit::Cut { source, .. } => {
                (source.dims()[0], Some(source.device()))
            }
            MomentEdit::Restart => (state.rows, None),
        };
        // Restarting means dropping the state.
        let Some(device) = device else {
            return HostState { rows, inner: None };
        };
        let mut sink = StateSink::default();
        inner.state_flatten("", &mut sink);
        // Something of another shape than the parameter has no parts.
        if let MomentEdit::Cut { parts, .. } = edit {
            let has_parts = |data: &TensorData| match data.shape()[..] {
                [first, width] => first == state.rows && width.is_multiple_of((*parts).max(1)),
                _ => false,
            };
            if !sink.tensors.iter().all(|(_, data)| has_parts(data)) {
                return HostState { rows, inner: None };
            }
        }
        let mut source = StateSource::new(sink.scalars.into_iter().collect());
        for (name, data) in sink.tensors {
            source.insert_tensor(name, edited(data, state.rows, edit, &device));
        }
        HostState {
            rows,
            inner: O::State::<2>::state_unflatten("", &mut source, &device),
        }
    }
}

/// The tensor after the edit, if it has one row per parameter row.
fn edited(data: TensorData, rows: usize, edit: &MomentEdit, device: &Device) -> TensorData {
    let mut shape = data.shape().to_vec();
    if shape.first() != Some(&rows) || rows == 0 || !data.dtype().is_float() {
        return data;
    }
    let width = data.num_elements() / rows;
    let dtype = data.dtype();
    let Ok(values) = data.clone().convert::<f32>().try_into_vec::<f32>() else {
        return data;
    };
    let moment = Tensor::<2>::from_data(TensorData::new(values, [rows, width]), device);
    let moment = edit.apply(moment);
    shape[0] = moment.dims()[0];
    if let (MomentEdit::Cut { .. }, Some(width)) = (edit, shape.get_mut(1)) {
        *width = moment.dims()[1];
    }
    match moment.into_data().convert::<f32>().try_into_vec::<f32>() {
        Ok(values) => TensorData::new(values, shape).convert_dtype(dtype),
        Err(_) => data,
    }
}
