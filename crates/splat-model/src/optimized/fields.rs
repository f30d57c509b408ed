//! Visitors and mappers of the parameters that fields name, as `[N, width]` tensors of any original
//! rank.

use std::collections::HashMap;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor};

use super::FieldGradients;
use crate::{LearningRates, SplatModel};

/// Reshapes `[N, ...]` to `[N, width]`.
pub(super) fn flat<const D: usize>(value: Tensor<D>) -> Tensor<2> {
    let dims = value.dims();
    let width: usize = dims[1..].iter().product();
    // Burn's reshape interprets zero as "keep this dimension".
    value.reshape([dims[0], width])
}

/// Paths of all float parameters.
#[derive(Default)]
pub(super) struct Paths {
    pub(super) path: Vec<String>,
    pub(super) found: Vec<String>,
}

impl ModuleVisitor for Paths {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, _: &Param<Tensor<D>>) {
        self.found.push(self.path.join("."));
    }
}

/// A visitor of parameters that are fields.
pub(super) trait VisitField {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>);
}

pub(super) struct FieldVisitor<V> {
    /// Field names by path.
    pub(super) names: HashMap<String, String>,
    pub(super) path: Vec<String>,
    pub(super) visit: V,
}

impl<V: VisitField> ModuleVisitor for FieldVisitor<V> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(name) = self.names.get(&self.path.join(".")) {
            self.visit.visit(name, param);
        }
    }
}

impl<V> FieldVisitor<V> {
    pub(super) fn new(names: HashMap<String, String>, visit: V) -> Self {
        Self {
            names,
            path: Vec::new(),
            visit,
        }
    }
}

/// The first field that autodiff does not track.
#[derive(Default)]
pub(super) struct Untracked(pub(super) Option<String>);

impl VisitField for &mut Untracked {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>) {
        if !param.is_require_grad() {
            self.0.get_or_insert_with(|| name.to_owned());
        }
    }
}

pub(super) struct ValuesOf<F>(pub(super) F);

impl<F: FnMut(&str, Tensor<2>)> VisitField for ValuesOf<F> {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>) {
        let value = param.val();
        let value = if value.device().is_autodiff() {
            value.inner()
        } else {
            value
        };
        (self.0)(name, flat(value));
    }
}

/// The value of a field `[N, width]`, in the autodiff graph where the model is.
pub(crate) fn tracked_field<M: SplatModel>(model: &M, name: &str) -> Option<Tensor<2>> {
    let fields = model.fields(&LearningRates::default()).into_iter();
    let field = fields.filter(|field| field.name == name);
    let names = field.map(|field| (field.path, field.name)).collect();
    let mut found = Tracked(None);
    model.visit(&mut FieldVisitor::new(names, &mut found));
    found.0
}

struct Tracked(Option<Tensor<2>>);

impl VisitField for &mut Tracked {
    fn visit<const D: usize>(&mut self, _: &str, param: &Param<Tensor<D>>) {
        self.0 = Some(flat(param.val()));
    }
}

pub(super) struct GradientsOf<'a> {
    pub(super) gradients: &'a mut Gradients,
    pub(super) taken: &'a mut FieldGradients,
}

impl VisitField for GradientsOf<'_> {
    fn visit<const D: usize>(&mut self, name: &str, param: &Param<Tensor<D>>) {
        if param.is_require_grad()
            && let Some(gradient) = param.val().grad_remove(self.gradients)
        {
            self.taken.insert(name.to_owned(), flat(gradient));
        }
    }
}

/// Maps the values of fields outside the autodiff graph. A value being changed has no other owner,
/// so that an optimiser can write into its memory.
pub(super) fn change<M: Module>(
    model: &mut Option<M>,
    names: HashMap<String, String>,
    map: impl FnMut(&str, Tensor<2>) -> Tensor<2>,
) {
    let mut mapper = FieldMapper {
        names,
        path: Vec::new(),
        map,
    };
    *model = model.take().map(|whole| whole.map(&mut mapper));
}

struct FieldMapper<F> {
    names: HashMap<String, String>,
    path: Vec<String>,
    map: F,
}

impl<F: FnMut(&str, Tensor<2>) -> Tensor<2>> ModuleMapper for FieldMapper<F> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let Some(name) = self.names.get(&self.path.join(".")) else {
            return param;
        };
        param.map(|value| {
            outside_graph(value, |value| {
                let mut dims = value.dims();
                let value = (self.map)(name, flat(value));
                dims[0] = value.dims()[0];
                value.reshape(dims)
            })
        })
    }
}

/// Remakes the value of a parameter outside the autodiff graph; the result is a leaf of the graph
/// where the value was one.
pub(crate) fn outside_graph<const D: usize>(
    value: Tensor<D>,
    make: impl FnOnce(Tensor<D>) -> Tensor<D>,
) -> Tensor<D> {
    let (requires_grad, tracked) = (value.is_require_grad(), value.device().is_autodiff());
    let strategy = value.gradient_checkpointing_strategy();
    let value = if tracked { value.inner() } else { value };
    let value = make(value);
    if !tracked {
        return value;
    }
    let mut value = Tensor::from_inner(value);
    if let Some(strategy) = strategy {
        value = value.with_gradient_checkpointing_strategy(strategy);
    }
    value.set_require_grad(requires_grad)
}
