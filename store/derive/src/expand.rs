//! The implementations that the derive writes, and the shapes of types that it refuses.

use proc_macro2::TokenStream;
use quote::{quote, quote_spanned};
use syn::ext::IdentExt;
use syn::spanned::Spanned;
use syn::{Data, DataEnum, DeriveInput, Error, Field, Fields, Ident, Result, Type};

use crate::attributes::{Bound, Encoding, FieldAttributes, TypeAttributes, check_serde, is_repr_c};

/// Writes the implementations for one type.
pub(crate) fn item(input: &DeriveInput) -> Result<TokenStream> {
    if !input.generics.params.is_empty() {
        return Err(Error::new_spanned(
            &input.generics,
            "an item type has one schema, so it has no type, lifetime or const parameters",
        ));
    }
    let attributes = TypeAttributes::read(&input.attrs)?;
    check_serde(&input.attrs)?;
    let name = attributes
        .name
        .unwrap_or_else(|| input.ident.unraw().to_string());
    match (&input.data, attributes.encoding) {
        (Data::Struct(data), Encoding::Plain) => {
            let fields = named_fields(&input.ident, &data.fields)?;
            if !is_repr_c(&input.attrs)? {
                return Err(Error::new_spanned(
                    &input.ident,
                    "a plain item is read in place by other programs: add `#[repr(C)]` alone, or `#[ddx(encoding = \"bincode\")]`",
                ));
            }
            plain_struct(&input.ident, &name, &fields)
        }
        (Data::Struct(data), Encoding::Bincode) => {
            let fields = named_fields(&input.ident, &data.fields)?;
            bincode_struct(&input.ident, &name, &fields)
        }
        (Data::Enum(data), Encoding::Bincode) => bincode_enum(&input.ident, &name, data),
        (Data::Enum(_), Encoding::Plain) => Err(Error::new_spanned(
            &input.ident,
            "an enum is not valid under every bit pattern: use a number, or `#[ddx(encoding = \"bincode\")]`",
        )),
        (Data::Union(_), _) => Err(Error::new_spanned(
            &input.ident,
            "a union does not say which of its fields holds: use a struct",
        )),
    }
}

fn named_fields<'a>(ident: &Ident, fields: &'a Fields) -> Result<Vec<(&'a Ident, &'a Field)>> {
    let named: Vec<_> = fields
        .iter()
        .filter_map(|field| field.ident.as_ref().map(|ident| (ident, field)))
        .collect();
    match (fields, named.is_empty()) {
        (Fields::Named(_), false) => Ok(named),
        (Fields::Unnamed(_), _) => Err(Error::new_spanned(
            fields,
            "a schema names its fields: write `struct Name { field: Type }`",
        )),
        (Fields::Named(_) | Fields::Unit, _) => {
            Err(Error::new_spanned(ident, "an item has at least one field"))
        }
    }
}

fn plain_struct(ident: &Ident, name: &str, fields: &[(&Ident, &Field)]) -> Result<TokenStream> {
    let schema_fields = fields
        .iter()
        .map(|(field_ident, field)| {
            check_serde(&field.attrs)?;
            let base = schema_field(field_ident, field)?;
            Ok(quote! { #base.at(::core::mem::offset_of!(#ident, #field_ident)) })
        })
        .collect::<Result<Vec<_>>>()?;
    let proofs = fields.iter().map(|(_, field)| plain_proof(&field.ty));
    let gaps = gap_proofs(ident, fields);
    Ok(quote! {
        #[automatically_derived]
        impl ::ddx_store::item::Typed for #ident {
            fn ty() -> ::ddx_store::schema::Type {
                ::ddx_store::schema::Type::plain_struct(
                    ::core::mem::size_of::<Self>(),
                    ::std::vec![#(#schema_fields),*],
                )
            }
        }

        #[automatically_derived]
        impl ::ddx_store::item::Item for #ident {
            fn schema() -> ::ddx_store::schema::Schema {
                ::ddx_store::schema::Schema::of::<Self>(
                    #name,
                    ::ddx_store::schema::Encoding::Plain,
                )
            }

            fn encode(
                &self,
                out: &mut ::std::vec::Vec<u8>,
            ) -> ::core::result::Result<(), ::ddx_store::schema::SchemaError> {
                out.extend_from_slice(::ddx_store::item::plain::bytes(self));
                ::core::result::Result::Ok(())
            }

            fn as_payload(&self) -> ::core::option::Option<&[u8]> {
                ::core::option::Option::Some(::ddx_store::item::plain::bytes(self))
            }

            fn decode(
                payload: &[u8],
            ) -> ::core::result::Result<Self, ::ddx_store::schema::SchemaError> {
                ::ddx_store::item::plain::read(payload)
            }
        }

        const _: () = {
            #(#proofs)*
            #(#gaps)*
        };

        // SAFETY: every field is plain and there is no byte between or after the fields: the constant above does not
        // compile otherwise. The type is `repr(C)`, as the derive has checked.
        #[automatically_derived]
        unsafe impl ::ddx_store::item::Plain for #ident {}
    })
}

/// Fails to compile, at the field, where the field's type is not plain.
fn plain_proof(ty: &Type) -> TokenStream {
    quote_spanned! { ty.span() =>
        {
            const fn is_plain<T: ::ddx_store::item::Plain>() {}
            is_plain::<#ty>();
        }
    }
}

/// Fails to compile where a field does not begin at the end of the one before, or the struct does not end at its last.
fn gap_proofs(ident: &Ident, fields: &[(&Ident, &Field)]) -> Vec<TokenStream> {
    let end_of = |(field_ident, field): &(&Ident, &Field)| {
        let ty = &field.ty;
        quote! { ::core::mem::offset_of!(#ident, #field_ident) + ::core::mem::size_of::<#ty>() }
    };
    let mut proofs: Vec<_> = fields
        .windows(2)
        .filter_map(|pair| {
            let [before, after @ (after_ident, _)] = pair else {
                return None;
            };
            let end = end_of(before);
            let fault = format!(
                "padding between `{}` and `{}`: put larger fields first, or fill the gap with a field of `[u8; N]`",
                before.0, after.0
            );
            Some(quote! {
                ::core::assert!(::core::mem::offset_of!(#ident, #after_ident) == #end, #fault);
            })
        })
        .collect();
    if let Some(last) = fields.last() {
        let end = end_of(last);
        let fault = format!(
            "padding after `{}`: fill the end with a field of `[u8; N]`",
            last.0
        );
        proofs.push(quote! {
            ::core::assert!(::core::mem::size_of::<#ident>() == #end, #fault);
        });
    }
    proofs
}

fn bincode_struct(ident: &Ident, name: &str, fields: &[(&Ident, &Field)]) -> Result<TokenStream> {
    let schema_fields = fields
        .iter()
        .map(|(field_ident, field)| {
            check_serde(&field.attrs)?;
            schema_field(field_ident, field)
        })
        .collect::<Result<Vec<_>>>()?;
    let ty = quote! {
        ::ddx_store::schema::Type::bincode_struct(::std::vec![#(#schema_fields),*])
    };
    Ok(bincode_item(ident, name, &ty))
}

fn bincode_enum(ident: &Ident, name: &str, data: &DataEnum) -> Result<TokenStream> {
    let mut names = Vec::new();
    for variant in &data.variants {
        check_serde(&variant.attrs)?;
        if !matches!(variant.fields, Fields::Unit) {
            return Err(Error::new_spanned(
                variant,
                "a variant with data has no type in a schema: use a struct of options",
            ));
        }
        names.push(variant.ident.unraw().to_string());
    }
    if names.is_empty() {
        return Err(Error::new_spanned(
            ident,
            "an enum has at least one variant",
        ));
    }
    let ty = quote! {
        ::ddx_store::schema::Type::Enum(
            ::std::vec![#(::std::borrow::ToOwned::to_owned(#names)),*],
        )
    };
    Ok(bincode_item(ident, name, &ty))
}

fn bincode_item(ident: &Ident, name: &str, ty: &TokenStream) -> TokenStream {
    quote! {
        #[automatically_derived]
        impl ::ddx_store::item::Typed for #ident {
            fn ty() -> ::ddx_store::schema::Type {
                #ty
            }
        }

        #[automatically_derived]
        impl ::ddx_store::item::Item for #ident {
            fn schema() -> ::ddx_store::schema::Schema {
                ::ddx_store::schema::Schema::of::<Self>(
                    #name,
                    ::ddx_store::schema::Encoding::Bincode,
                )
            }

            fn encode(
                &self,
                out: &mut ::std::vec::Vec<u8>,
            ) -> ::core::result::Result<(), ::ddx_store::schema::SchemaError> {
                ::ddx_store::item::encode_bincode(self, out)
            }

            fn decode(
                payload: &[u8],
            ) -> ::core::result::Result<Self, ::ddx_store::schema::SchemaError> {
                ::ddx_store::item::decode_bincode(payload)
            }
        }
    }
}

fn schema_field(ident: &Ident, field: &Field) -> Result<TokenStream> {
    let FieldAttributes { unit, range } = FieldAttributes::read(&field.attrs)?;
    let (name, ty) = (ident.unraw().to_string(), &field.ty);
    let unit = unit.map(|unit| quote! { .unit(#unit) });
    let range = range.map(|(low, high)| {
        let (low, high) = (bound(low), bound(high));
        quote! { .range(::ddx_store::schema::Range { low: #low, high: #high }) }
    });
    let typed = quote_spanned! { ty.span() => <#ty as ::ddx_store::item::Typed>::ty() };
    Ok(quote! { ::ddx_store::schema::Field::new(#name, #typed) #unit #range })
}

fn bound(bound: Option<Bound>) -> TokenStream {
    match bound {
        None => quote! { ::core::option::Option::None },
        Some(Bound::Integer(value)) => quote! {
            ::core::option::Option::Some(::ddx_store::schema::Number::Integer(#value))
        },
        Some(Bound::Float(value)) => quote! {
            ::core::option::Option::Some(::ddx_store::schema::Number::Float(#value))
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use syn::parse_quote;

    fn refusal(input: &DeriveInput) -> String {
        item(input).unwrap_err().to_string()
    }

    #[test]
    fn a_plain_struct_must_be_repr_c_and_nothing_else() {
        let bare = refusal(&parse_quote! { struct Pose { x: f64 } });
        let packed = refusal(&parse_quote! { #[repr(C, packed)] struct Pose { x: f64 } });

        assert!(bare.contains("add `#[repr(C)]` alone"), "{bare}");
        assert_eq!(packed, bare);
    }

    #[test]
    fn shapes_without_a_schema_are_refused_with_the_fix() {
        let cases: [(DeriveInput, &str); 7] = [
            (parse_quote! { struct P<T> { x: T } }, "parameters"),
            (
                parse_quote! { #[repr(C)] struct P(f64); },
                "names its fields",
            ),
            (
                parse_quote! { #[repr(C)] struct P {} },
                "at least one field",
            ),
            (
                parse_quote! { #[repr(u8)] enum P { A } },
                "encoding = \"bincode\"",
            ),
            (parse_quote! { union P { a: u8 } }, "use a struct"),
            (
                parse_quote! { #[ddx(encoding = "bincode")] enum P { A(u8) } },
                "struct of options",
            ),
            (
                parse_quote! { #[ddx(encoding = "bincode")] enum P {} },
                "at least one variant",
            ),
        ];
        for (input, fix) in cases {
            let fault = refusal(&input);
            assert!(fault.contains(fix), "{fault}");
        }
    }

    #[test]
    fn serde_attributes_that_change_the_bytes_are_refused_wherever_they_stand() {
        let cases: [DeriveInput; 5] = [
            parse_quote! { #[ddx(encoding = "bincode")] struct P { #[serde(skip)] x: u8 } },
            parse_quote! { #[ddx(encoding = "bincode")] struct P { #[serde(rename = "y", default)] x: u8 } },
            parse_quote! { #[ddx(encoding = "bincode")] #[serde(untagged)] struct P { x: u8 } },
            parse_quote! { #[ddx(encoding = "bincode")] enum P { #[serde(other)] A } },
            parse_quote! { #[repr(C)] struct P { #[serde(with = "m")] x: u8 } },
        ];
        for input in cases {
            let fault = refusal(&input);
            assert!(fault.contains("differ from the schema"), "{fault}");
        }
        let harmless = parse_quote! {
            #[ddx(encoding = "bincode")]
            #[serde(rename_all = "camelCase")]
            struct P { #[serde(rename = "y")] x: u8 }
        };
        assert!(item(&harmless).is_ok());
    }

    #[test]
    fn wrong_attributes_are_refused() {
        let cases: [(DeriveInput, &str); 6] = [
            (
                parse_quote! { #[ddx(encoding = "json")] struct P { x: u8 } },
                "`plain` or `bincode`",
            ),
            (
                parse_quote! { #[ddx(nam = "P")] struct P { x: u8 } },
                "`name` and `encoding`",
            ),
            (
                parse_quote! { #[repr(C)] struct P { #[ddx(size = "1")] x: u8 } },
                "`unit` and `range`",
            ),
            (
                parse_quote! { #[repr(C)] struct P { #[ddx(range = "1")] x: u8 } },
                "`low..high`",
            ),
            (
                parse_quote! { #[repr(C)] struct P { #[ddx(range = "2..1")] x: u8 } },
                "`low..high`",
            ),
            (
                parse_quote! { #[repr(C)] struct P { #[ddx(unit = "m", unit = "s")] x: u8 } },
                "twice",
            ),
        ];
        for (input, rule) in cases {
            let fault = refusal(&input);
            assert!(fault.contains(rule), "{fault}");
        }
    }
}
