// Vector types of the CPU branch: clang's, so arithmetic, comparison and ?: work lane by lane, and [j] is a lane.
//
// On a CPU only, the types below (letter: element, digit: lanes), mask_of and mask_of_four.
#pragma once
#if !defined(__CUDA_ARCH__)
// The alignment is that of one element: a pointer to any element may be cast to a pointer to the vector that starts
// there.
typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
typedef double d8 __attribute__((ext_vector_type(8), aligned(8)));
typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
typedef unsigned u8 __attribute__((ext_vector_type(8), aligned(4)));
typedef long long l8 __attribute__((ext_vector_type(8), aligned(8)));
typedef unsigned short h8 __attribute__((ext_vector_type(8), aligned(2)));
typedef unsigned char c8 __attribute__((ext_vector_type(8), aligned(1)));
typedef float v4 __attribute__((ext_vector_type(4), aligned(4)));
typedef double d4 __attribute__((ext_vector_type(4), aligned(8)));
typedef int i4 __attribute__((ext_vector_type(4), aligned(4)));
typedef unsigned u4 __attribute__((ext_vector_type(4), aligned(4)));
typedef bool b8 __attribute__((ext_vector_type(8)));
typedef bool b4 __attribute__((ext_vector_type(4)));
// Bit j is set where lane j of a comparison of eight is true.
static constexpr auto mask_of = [](auto lanes) {
    return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
};
// The same for a comparison of four.
static constexpr auto mask_of_four = [](auto lanes) {
    return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b4)) & 15u;
};
// Sixteen lanes.
typedef float v16 __attribute__((ext_vector_type(16), aligned(4)));
typedef double d16 __attribute__((ext_vector_type(16), aligned(8)));
typedef int i16 __attribute__((ext_vector_type(16), aligned(4)));
typedef bool b16 __attribute__((ext_vector_type(16)));
#endif
