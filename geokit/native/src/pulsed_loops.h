// Loops of OpenVDB's tools and NanoVDB's converters that call the pulse of an operation (see docs/design/native-bridge.md).
// Include it before their headers; library_grids.h does.
#pragma once

#include "pulse.h"

#include <openvdb/util/NullInterrupter.h>
#include <openvdb/version.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_invoke.h>
#include <tbb/parallel_reduce.h>
#include <tbb/task_group.h>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <memory>
#include <mutex>
#include <type_traits>
#include <utility>

namespace geokit {

// Gives OpenVDB's tools the pulse of an operation. They would go on with half-made values if it returned true; it throws
// instead.
struct Interrupter : openvdb::util::NullInterrupter {
    explicit Interrupter(const Pulse& pulse_) : pulse(pulse_) {}
    bool wasInterrupted(int = -1) override
    {
        pulse();
        return false;
    }
    const Pulse& pulse;
};

namespace pulsed {

// Of a loop: each takes no longer than a hundredth of it, so a loop of ten seconds answers within a tenth.
constexpr size_t kPieces = 128;
// Items of a piece at least: what a body prepares for each, such as accessors, costs as much as a few of them.
constexpr size_t kLeastItems = 8;

// The first exception of a loop. It is thrown where the loop ends, and not to TBB, which would cancel the loop: trees that
// are destroyed within a cancelled loop do not free their leaves, because they do that in a loop of their own.
class First {
public:
    bool thrown() const { return thrown_; }
    template<typename Run>
    void run(const Run& run)
    {
        if (thrown_) return;
        try {
            run();
        } catch (...) {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (!thrown_) error_ = std::current_exception();
            thrown_ = true;
        }
    }
    void rethrow()
    {
        if (thrown_) std::rethrow_exception(error_);
    }

private:
    std::atomic<bool> thrown_{false};
    std::mutex mutex_;
    std::exception_ptr error_;
};

// Runs a part of a loop in pieces, first to last, with the pulse before each.
template<typename Range, typename Run>
void in_pieces(const Range& range, size_t most, const Pulse& pulse, First& first, const Run& run)
{
    if (size_t(range.size()) > most && range.is_divisible()) {
        Range left(range);
        const Range right(left, ::tbb::split());
        in_pieces(left, most, pulse, first, run);
        in_pieces(right, most, pulse, first, run);
        return;
    }
    first.run([&] {
        pulse();
        run(range);
    });
}

template<typename Range>
size_t piece_of(const Range& range)
{ return std::max(size_t(range.size()) / kPieces, kLeastItems); }

// Bodies whose loops are not interrupted, because they work on nodes that only a later step gives an owner.
template<typename Body>
inline constexpr bool kWhole = false;

// What the body of an interrupted reduction has made for a later step to own.
template<typename Body>
struct Unowned {
    static void destroy(Body&) {}
};

// The body of a reduction, in TBB's form with join().
template<typename Body>
class Reduction {
public:
    Reduction(Body& body, size_t most, const Pulse& pulse, First& first)
        : body_(&body), most_(most), pulse_(&pulse), first_(&first)
    {}
    Reduction(Reduction& other, ::tbb::split split)
        : own_(std::make_unique<Body>(*other.body_, split)), body_(own_.get()), most_(other.most_),
          pulse_(other.pulse_), first_(other.first_)
    {}
    Reduction(const Reduction&) = delete;
    Reduction& operator=(const Reduction&) = delete;
    ~Reduction()
    {
        if (!done_) Unowned<Body>::destroy(*body_);
    }
    template<typename Range>
    void operator()(const Range& range)
    {
        const PulseScope scope(pulse_);
        in_pieces(range, most_, *pulse_, *first_, [&](const Range& piece) { (*body_)(piece); });
    }
    void join(Reduction& other)
    {
        if (first_->thrown()) return;
        first_->run([&] { body_->join(*other.body_); });
        other.done();
    }
    void done() { done_ = true; }

private:
    std::unique_ptr<Body> own_;
    Body* body_;
    size_t most_;
    const Pulse* pulse_;
    First* first_;
    bool done_ = false;
};

// What takes the place of `tbb` in the namespaces below: those functions, and TBB's for all the rest.
namespace tbb {

using namespace ::tbb;

template<typename Range, typename Body, typename... Rest>
void parallel_for(const Range& range, const Body& body, Rest&&... rest)
{
    const Pulse* const pulse = current_pulse;
    if constexpr (std::is_class_v<Range> && !kWhole<Body>) {
        if (pulse != nullptr) {
            const size_t most = piece_of(range);
            First first;
            // TBB gives each task a copy of the body, which may hold what threads cannot share, such as accessors.
            const auto pulsed = [body, &first, pulse, most](const Range& part) {
                const PulseScope scope(pulse);
                in_pieces(part, most, *pulse, first, body);
            };
            ::tbb::parallel_for(range, pulsed, std::forward<Rest>(rest)...);
            first.rethrow();
            return;
        }
    }
    ::tbb::parallel_for(range, body, std::forward<Rest>(rest)...);
}

template<typename Range, typename Body>
void parallel_reduce(const Range& range, Body& body)
{
    if (current_pulse == nullptr) {
        ::tbb::parallel_reduce(range, body);
        return;
    }
    First first;
    Reduction<Body> pulsed(body, piece_of(range), *current_pulse, first);
    ::tbb::parallel_reduce(range, pulsed);
    first.rethrow();
    pulsed.done();
}

// In pieces that depend on the range alone, since the value may be a sum, which rounds as its order says: NanoVDB's
// averages of nodes. TBB's own pieces depend on which thread is free.
template<typename Range, typename Value, typename Body, typename Join>
Value parallel_reduce(const Range& range, const Value& identity, const Body& body, const Join& join)
{
    const Pulse* const pulse = current_pulse;
    First first;
    const auto pulsed = [&body, &first, pulse](const Range& part, Value value) {
        const PulseScope scope(pulse);
        first.run([&] {
            pulse_if_any();
            value = body(part, std::move(value));
        });
        return value;
    };
    const Range pieces(range.begin(), range.end(), piece_of(range));
    Value result = ::tbb::parallel_deterministic_reduce(pieces, identity, pulsed, join);
    first.rethrow();
    return result;
}

// Tasks run on other threads too, which then work for the same operation.
template<typename Task>
auto in_operation(const Task& task, First& first)
{
    return [task, &first, pulse = current_pulse] {
        const PulseScope scope(pulse);
        first.run(task);
    };
}

class task_group {
public:
    template<typename Task>
    void run(const Task& task)
    { tasks_.run(in_operation(task, first_)); }
    void wait()
    {
        tasks_.wait();
        first_.rethrow();
    }

private:
    First first_;
    ::tbb::task_group tasks_;
};

template<typename... Tasks>
void parallel_invoke(const Tasks&... tasks)
{
    First first;
    ::tbb::parallel_invoke(in_operation(tasks, first)...);
    first.rethrow();
}

} // namespace tbb
} // namespace pulsed
} // namespace geokit

// A name that a header looks for in `tbb` is found in the innermost namespace of that name. openvdb::tree stays as it
// is: trees end their nodes in loops, in destructors too, where nothing may be thrown.
namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {
namespace tools {
namespace tbb = geokit::pulsed::tbb;
namespace morphology {
namespace tbb = ::tbb; // its loops steal nodes from trees and put them back
} // namespace morphology
} // namespace tools
} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb

namespace nanovdb {
namespace tbb = geokit::pulsed::tbb;
} // namespace nanovdb
